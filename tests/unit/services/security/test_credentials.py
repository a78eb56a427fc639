"""Keys and certificates on disk, the roster, the router's file, and who finds what."""

from __future__ import annotations

import json
import stat
from base64 import b64decode
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.exceptions import InvalidSignature

from services.cli.main import main
from services.security.authority import Authority
from services.security.kinds import Credential
from services.security.use import is_local, refuse_open_door, using
from shared import settings
from shared.config import BusConfig, Config
from shared.errors import ConfigError

DRIVER = Credential("driver", ("alpha",))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What `corridor secure init` makes."""
    monkeypatch.delenv("CORRIDOR_CREDENTIALS", raising=False)
    made = tmp_path / "secure"
    assert main(["secure", "init", str(made), "--robot", "alpha", "--host", "lab.example"]) == 0
    return made


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def router(folder: Path) -> dict[str, Any]:
    """The router's configuration."""
    text = (folder / "router/router.json5").read_text()
    tree: dict[str, Any] = json.loads(text.partition("\n")[2])
    zenoh.Config.from_json5(text)  # as zenohd reads it
    return tree


def trusted(folder: Path) -> list[x509.Certificate]:
    """Issuers whose certificates the router takes."""
    tls = router(folder)["transport"]["link"]["tls"]
    return x509.load_pem_x509_certificates(b64decode(tls["root_ca_certificate_base64"]))


def takes(folder: Path, one: x509.Certificate) -> bool:
    """Whether a certificate comes from an issuer that the router trusts."""
    for issuer in trusted(folder):
        with suppress(ValueError, InvalidSignature):
            one.verify_directly_issued_by(issuer)
            return True
    return False


def test_each_credential_has_a_folder_that_holds_no_more_than_its_own(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == {
        *("authority", "router", "replay", "learner", "actor", "operator", "watcher"),
        "driver-alpha",
    }
    for name in names - {"authority", "router"}:
        files = {path.name for path in (folder / name).iterdir()}
        assert files == {"key.pem", "cert.pem", "ca.pem"}
        subject = certificate(folder / name / "cert.pem").subject
        assert subject.rfc4514_string() == f"CN={name}"
        assert takes(folder, certificate(folder / name / "cert.pem"))
    for path in folder.rglob("*"):
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode == (0o700 if path.is_dir() else 0o600), path
    keys = {path.read_bytes() for path in folder.rglob("key.pem")}
    assert len(keys) == len(names)


def test_the_router_is_known_by_loopback_and_the_given_hosts(folder: Path) -> None:
    one = certificate(folder / "router/cert.pem")
    names = one.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["lab.example", "localhost"]
    addresses = {str(found) for found in names.get_values_for_type(x509.IPAddress)}
    assert addresses == {"127.0.0.1", "::1"}
    one.verify_directly_issued_by(certificate(folder / "replay/ca.pem"))


def test_the_file_of_the_router_encrypts_and_allows_only_what_is_listed(folder: Path) -> None:
    tree = router(folder)
    assert tree["mode"] == "router"
    assert tree["listen"]["endpoints"] == ["tls/0.0.0.0:7447"]
    assert tree["transport"]["link"]["tls"]["enable_mtls"] is True
    assert tree["transport"]["shared_memory"]["enabled"] is False
    assert tree["scouting"]["multicast"]["enabled"] is False
    assert tree["access_control"]["default_permission"] == "deny"
    subjects = {subject["id"] for subject in tree["access_control"]["subjects"]}
    assert subjects == {path.parent.name for path in folder.glob("*/key.pem")} - {
        "authority",
        "router",
    }
    assert tree["low_pass_filter"]


def test_what_is_revoked_or_replaced_is_no_longer_taken(folder: Path) -> None:
    old = certificate(folder / "driver-alpha/cert.pem")
    assert main(["secure", "add", "driver", "alpha", "--folder", str(folder)]) == 0
    assert not takes(folder, old)
    new = certificate(folder / "driver-alpha/cert.pem")
    assert takes(folder, new)
    assert main(["secure", "revoke", "driver", "alpha", "--folder", str(folder)]) == 0
    assert not takes(folder, new)
    assert not (folder / "driver-alpha").exists()
    subjects = {subject["id"] for subject in router(folder)["access_control"]["subjects"]}
    assert "driver-alpha" not in subjects
    assert main(["secure", "revoke", "driver", "alpha", "--folder", str(folder)]) == 2


def test_init_again_makes_only_what_is_missing_or_ends_soon(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*.pem")}
    again = ["secure", "init", str(folder), "--robot", "alpha", "--robot", "beta"]
    assert main(again) == 0
    after = {path: path.read_bytes() for path in folder.rglob("*.pem")}
    assert before.items() <= after.items()
    assert set(after) - set(before) == set((folder / "driver-beta").iterdir())
    Authority(folder).add(DRIVER, datetime.now(UTC) + timedelta(days=3))
    assert main(again) == 0
    assert Authority(folder).ends("driver-alpha") > datetime.now(UTC) + timedelta(days=800)
    assert main(["secure", "init", str(folder), "--host", "10.0.0.7"]) == 0
    assert Authority(folder).hosts == ["10.0.0.7", "127.0.0.1", "::1", "lab.example", "localhost"]


def test_containers_get_their_own_folder_each(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "volumes"
    names = ("router", "replay", "learner", "actor", "operator", "driver")
    for name in names:
        (target / name).mkdir(parents=True)
    line = ["secure", "init", str(folder), "--robot", "alpha", "--deliver", str(target)]
    assert main(line) == 0
    assert main(line) == 0
    assert {path.name for path in target.iterdir()} == set(names)
    for name in names:
        source = folder / ("driver-alpha" if name == "driver" else name)
        copied = {path.name: path.read_bytes() for path in (target / name).iterdir()}
        assert copied == {path.name: path.read_bytes() for path in source.iterdir()}
        assert {stat.S_IMODE(path.stat().st_mode) for path in (target / name).iterdir()} == {0o600}


def test_commands_without_an_authority_say_so_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["add", "replay"], ["revoke", "replay"], ["router"], ["list"]):
        assert main(["secure", *words, "--folder", str(tmp_path)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "has no authority; make one: corridor secure init" in said


def test_list_tells_who_may_connect(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["secure", "list", "--folder", str(folder)]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows] == [
        *("router", "actor", "driver-alpha", "learner", "operator", "replay", "watcher")
    ]


def test_a_process_finds_its_own_folder(folder: Path) -> None:
    config = Config(bus=BusConfig(credentials=str(folder)))
    assert using(config, "replay").bus.credentials == str(folder / "replay")
    assert using(config, "pilot", "operator").bus.credentials == str(folder / "operator")
    exact = Config(bus=BusConfig(credentials=str(folder / "watcher")))
    assert using(exact, "operator").bus.credentials == str(folder / "watcher")
    assert using(Config(), "replay") == Config()
    with pytest.raises(ConfigError, match=r"expected cert.pem in .* or below in driver-gamma"):
        using(config, "driver-gamma")


def test_credentials_are_no_part_of_what_must_agree(folder: Path) -> None:
    given = settings.load(env={"CORRIDOR_CREDENTIALS": str(folder)})
    assert given.bus.credentials == str(folder)
    assert given.fingerprint() == Config().fingerprint()


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/localhost:0", True),
        ("tls/[::1]:7447", True),
        ("unixsock-stream//tmp/x.sock", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.0.2.10:7447", False),
        ("tcp/lab.example:7447", False),
        ("tcp/:7447", False),
        ("udp/0.0.0.0:7447?rel=0", False),
        ("tcp/0.0.0.0:7447#iface=lo", False),
    ],
)
def test_a_router_open_to_everybody_stays_on_this_machine(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) == local
    refuse_open_door(endpoint, "somewhere", insecure=False)
    refuse_open_door(endpoint, "", insecure=True)
    if not local:
        with pytest.raises(ConfigError, match="--credentials"):
            refuse_open_door(endpoint, "", insecure=False)


def test_router_and_up_refuse_an_open_door(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in ("router", "up"):
        assert main([command, "--listen", "tcp/0.0.0.0:7447"]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "give --credentials (corridor secure init), or --insecure" in said
    assert list(tmp_path.iterdir()) == []
