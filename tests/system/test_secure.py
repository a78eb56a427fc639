"""A real router with real certificates: what each credential gets through, and who gets in.

Denials are silent, so nobody is asked: every credential tries everything at once, on sessions of
its own for saying and for hearing, and what came through is compared with the table.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from cluster import Cluster, make_config
from permitted import CREDENTIALS, PLACES, TOKEN_PLACES, may, may_announce

from benchmarks.waiting import wait_until
from services.monitor import health
from services.security import router_file
from services.security.authority import Authority
from services.security.kinds import Credential
from services.security.rules import TOKENS
from services.security.use import using
from shared.bus import Bus, open_router
from shared.config import BusConfig
from shared.errors import RouterMissing
from shared.keys import OBSERVATION, ROBOT_WORLD, Stream
from shared.zenoh_settings import zenoh_config

pytestmark = pytest.mark.system

RUN = "demo"
DAY = timedelta(days=1)
ROUTER = [sys.executable, "-m", "services.cli", "router", "--tethered"]


class Site(NamedTuple):
    """A folder of credentials, and where the router that uses it listens."""

    folder: Path
    endpoint: str

    def open(self, name: str) -> zenoh.Session:
        """A session with the credential of this name; empty: without any."""
        folder = str(self.folder / name) if name else ""
        return zenoh.open(zenoh_config("client", connect=[self.endpoint], credentials=folder))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """One router for all tests here, and certificates that hold or do not hold."""
    folder = tmp_path_factory.mktemp("site") / "secure"
    authority, until = Authority.create(folder), datetime.now(UTC) + DAY
    authority.certify_router([], until)
    for credential in CREDENTIALS:
        authority.add(credential, until)
    replaced, revoked = Credential("driver", ("gamma",)), Credential("operator", ("eve",))
    for name, credential in (("replaced", replaced), ("revoked", revoked)):
        shutil.copytree(authority.add(credential, until), folder / name)
    authority.add(replaced, until)
    authority.revoke(revoked)
    authority.add(Credential("operator", ("late",)), datetime.now(UTC) - timedelta(seconds=1))
    router_file.write(authority)
    foreign = Authority.create(folder.parent / "foreign").add(Credential("replay"), until)
    shutil.copytree(foreign, folder / "foreign")
    shutil.copytree(foreign, folder / "foreign-but-trusting")
    shutil.copy(folder / "replay" / "ca.pem", folder / "foreign-but-trusting" / "ca.pem")
    command = [*ROUTER, "--listen", "tcp/127.0.0.1:0", "--credentials", str(folder)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        endpoint = process.stdout.readline().strip()
        assert endpoint.startswith("tls/127.0.0.1:")
        yield Site(folder, endpoint)
        process.stdin.close()
        assert process.wait(10) == 0


class Everybody:
    """All credentials: each hears and answers wherever it can on one session, says on another."""

    def __init__(self, site: Site, stack: ExitStack) -> None:
        self.heard: set[tuple[str, str, str]] = set()
        self._lock = threading.Lock()
        self.hearing = {who: stack.enter_context(site.open(who.name)) for who in CREDENTIALS}
        self.saying = {who: stack.enter_context(site.open(who.name)) for who in CREDENTIALS}
        self._kept: list[object] = []
        for who, session in self.hearing.items():
            for stream, ident in PLACES:
                self._listen(who, session, stream, stream.key(RUN, ident))

    def _listen(self, who: Credential, session: zenoh.Session, stream: Stream, key: str) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            with self._lock:
                said = sample.payload.to_string()
                self.heard.add((who.name, str(sample.key_expr), said))

        def on_query(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, who.name)

        if stream.delivery == "latest":
            self._kept.append(session.declare_subscriber(key, on_sample))
        else:
            self._kept.append(session.declare_queryable(key, on_query))

    def put(self, who: Credential, key: str) -> None:
        """Publish its own name there."""
        self.saying[who].put(key, who.name, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, who: Credential, key: str) -> set[str]:
        """Names of those who answer."""
        replies = self.saying[who].get(
            key,
            payload=b"?",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=5.0,
        )
        return {reply.ok.payload.to_string() for reply in replies if reply.ok}

    def hold(self, who: Credential, key: str) -> None:
        """Declare a liveliness token."""
        self._kept.append(self.hearing[who].liveliness().declare_token(key))

    def look(self, who: Credential, key: str) -> set[str]:
        """Liveliness tokens that it sees."""
        replies = self.saying[who].liveliness().get(key, timeout=5.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok}


@pytest.fixture(scope="module")
def everybody(site: Site) -> Iterator[Everybody]:
    with ExitStack() as stack:
        there = Everybody(site, stack)
        operator = CREDENTIALS[6]

        def answers() -> bool:  # the last declaration of the last session has arrived
            return there.ask(operator, ROBOT_WORLD.key(RUN, "beta")) == {"driver-beta"}

        wait_until(answers, 10, "queryables are declared")
        yield there


def test_only_what_the_table_says_is_heard(everybody: Everybody) -> None:
    latest = [(s, ident) for s, ident in PLACES if s.delivery == "latest"]
    expected = {
        (hearer.name, stream.key(RUN, ident), sayer.name)
        for stream, ident in latest
        for sayer in CREDENTIALS
        for hearer in CREDENTIALS
        if may(sayer, "put", stream, ident) and may(hearer, "hear", stream, ident)
    }

    def all_said() -> bool:
        for sayer in CREDENTIALS:
            for stream, ident in latest:
                everybody.put(sayer, stream.key(RUN, ident))
        return everybody.heard >= expected

    wait_until(all_said, 10, "all that is allowed comes through")
    all_said()  # denied ones had as many chances
    for who in CREDENTIALS:  # and have passed the router when a later question is answered
        everybody.look(who, f"{RUN}/alive/**")
    assert everybody.heard == expected


def test_only_those_of_the_table_ask_and_answer(everybody: Everybody) -> None:
    requests = [(s, ident) for s, ident in PLACES if s.delivery == "request"]
    for stream, ident in requests:
        for who in CREDENTIALS:
            answering = {a.name for a in CREDENTIALS if may(a, "answer", stream, ident)}
            expected = answering if may(who, "ask", stream, ident) else set()
            found = everybody.ask(who, stream.key(RUN, ident))
            assert found == expected, (stream.name, ident, who.name)


def test_tokens_are_seen_by_all_and_held_by_those_they_name(everybody: Everybody) -> None:
    expected = set()
    for number, who in enumerate(CREDENTIALS):
        for pattern in TOKENS:
            for service, ident in TOKEN_PLACES:
                life = f"{number:012x}"
                names = {"run": RUN, "service": service, "id": ident, "life": life}
                key = pattern.format(**names, protocol=1, config="f")
                everybody.hold(who, key)
                if may_announce(who, service, ident):
                    expected.add(key)
    looks = [pattern.split("{service}")[0].format(run=RUN) + "**" for pattern in TOKENS]
    for who in CREDENTIALS:

        def seen(who: Credential = who) -> set[str]:
            return {key for look in looks for key in everybody.look(who, look)}

        wait_until(lambda seen=seen: seen() >= expected, 10, "tokens that are allowed")
        assert seen() == expected, who.name


def test_wide_keys_and_large_messages_get_nobody_through(everybody: Everybody) -> None:
    driver, operator = CREDENTIALS[0], CREDENTIALS[6]
    session = everybody.saying[driver]
    key = OBSERVATION.key(RUN, "alpha")
    before = set(everybody.heard)
    for wide in ("**", f"{RUN}/**", f"{RUN}/robot/*/observation", f"{RUN}/*/alpha/*"):
        session.put(wide, "wide", congestion_control=zenoh.CongestionControl.BLOCK)
    large = "x" * (OBSERVATION.max_bytes + 1)
    session.put(key, large, congestion_control=zenoh.CongestionControl.BLOCK)
    session.put(key, "last", congestion_control=zenoh.CongestionControl.BLOCK)
    last = ("operator-anna", key, "last")
    wait_until(lambda: last in everybody.heard, 5, "a message of the right size")
    assert {said for _, _, said in everybody.heard - before} == {"last"}
    asking = everybody.saying[operator]
    big = b"x" * (ROBOT_WORLD.max_bytes + 1)
    for wide, payload in (
        ("**", b"?"),
        (f"{RUN}/robot/**", b"?"),
        (f"{RUN}/service/**", b"?"),
        ("@/**", b"?"),
        (ROBOT_WORLD.key(RUN, "alpha"), big),
    ):
        replies = asking.get(wide, payload=payload, target=zenoh.QueryTarget.ALL, timeout=5.0)
        ours = str(asking.zid())  # a session tells about itself
        assert [r for r in replies if r.ok and ours not in str(r.ok.key_expr)] == [], wide


STRANGERS = ("", "foreign", "foreign-but-trusting", "revoked", "replaced", "operator-late")


def test_only_certificates_that_hold_get_a_connection(site: Site) -> None:
    def refused(name: str) -> bool:
        try:
            site.open(name).close()  # type: ignore[no-untyped-call]
        except zenoh.ZError:
            return True
        return False

    plain = site._replace(endpoint=site.endpoint.replace("tls/", "tcp/"))
    with ThreadPoolExecutor(8) as pool:  # each failure takes a second
        found = list(pool.map(refused, STRANGERS))
        unencrypted = pool.submit(lambda: plain.open("")).exception(10)
    assert dict(zip(STRANGERS, found, strict=True)) == dict.fromkeys(STRANGERS, True)
    assert isinstance(unencrypted, zenoh.ZError)
    assert not refused("driver-gamma")  # its certificate was made anew: that one holds
    missing = BusConfig(endpoint=site.endpoint, credentials=str(site.folder / "revoked"))
    with pytest.raises(RouterMissing, match="that takes the credentials in"):
        Bus(missing, RUN)


def test_a_client_takes_a_router_at_the_host_of_its_certificate_only(site: Site) -> None:
    file = site.folder / "router" / "router.json5"
    with open_router("tcp/127.0.0.3:0", file) as elsewhere, pytest.raises(zenoh.ZError):
        site._replace(endpoint=elsewhere).open("replay")


def lines(path: Path) -> Sequence[str]:
    return path.read_text().splitlines() if path.exists() else ()


def test_a_run_learns_behind_a_guarded_router(tmp_path: Path, run_name: str) -> None:
    authority, until = Authority.create(tmp_path / "secure"), datetime.now(UTC) + DAY
    authority.certify_router([], until)
    config = make_config(run_name, memory={"fill": "none"})
    for kind in ("replay", "learner", "actor", "operator"):
        authority.add(Credential(kind), until)
    authority.add(Credential("driver", (config.robot.id,)), until)
    router_file.write(authority)
    bus = config.bus.model_copy(update={"credentials": str(tmp_path / "secure")})
    config = config.model_copy(update={"bus": bus})
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "replay", "learner", "actor", "driver")
        done = tmp_path / "run" / "training.csv"
        wait_until(lambda: len(lines(done)) > 1, 60, "an episode learnt")
        for name in ("driver", "actor", "replay", "learner"):  # with no more than its own
            own = using(config, name, f"{name}-{config.robot.id}")
            assert health.check(name, own)
        cluster.stop("router")
        before = len(lines(done))
        cluster.start("router")
        wait_until(lambda: len(lines(done)) > before + 1, 60, "more episodes learnt")
        cluster.stop_all()
