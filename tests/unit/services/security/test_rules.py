"""The router's allow-lists say what the table of streams says, for every key and every message."""

from __future__ import annotations

from functools import cache

import pytest
import zenoh
from permitted import CREDENTIALS, PLACES, TOKEN_PLACES, may, may_announce

from services.security.kinds import Credential, check
from services.security.rules import TOKENS, access_control, size_limits
from shared.bus import REPLY_LIMIT
from shared.errors import ConfigError
from shared.keys import EPISODE, MIB, OBSERVATION, STREAMS

ACL = access_control(CREDENTIALS)
EACH = pytest.mark.parametrize("who", CREDENTIALS, ids=lambda who: who.name)


def allowed(who: Credential, flow: str, message: str, key: str) -> bool:
    """As Zenoh decides: some rule of a policy of this subject includes the key."""
    asked = zenoh.KeyExpr(key)
    return any(expression.includes(asked) for expression in expressions(who, flow, message))


@cache
def expressions(who: Credential, flow: str, message: str) -> tuple[zenoh.KeyExpr, ...]:
    (subject,) = (s["id"] for s in ACL["subjects"] if s["cert_common_names"] == [who.name])
    ids = {rule for p in ACL["policies"] if p["subjects"] == [subject] for rule in p["rules"]}
    return tuple(
        zenoh.KeyExpr(expression)
        for rule in ACL["rules"]
        if rule["id"] in ids and flow in rule["flows"] and message in rule["messages"]
        for expression in rule["key_exprs"]
    )


@EACH
def test_every_stream_is_allowed_to_those_the_table_names_and_to_nobody_else(
    who: Credential,
) -> None:
    for stream, ident in PLACES:
        key = stream.key("demo", ident)
        latest = stream.delivery == "latest"
        for action, pairs in {
            "put": [("ingress", "put")],
            "hear": [("ingress", "declare_subscriber"), ("egress", "put")],
            "ask": [("ingress", "query"), ("egress", "reply")],
            "answer": [("ingress", "declare_queryable"), ("ingress", "reply"), ("egress", "query")],
        }.items():
            expected = latest == (action in ("put", "hear")) and may(who, action, stream, ident)
            for flow, message in pairs:
                assert allowed(who, flow, message, key) == expected, (flow, message, key)


@EACH
def test_tokens_are_for_ones_own_names_and_everybody_sees_all(who: Credential) -> None:
    for pattern in TOKENS:
        for service, ident in TOKEN_PLACES:
            key = pattern.format(
                run="demo", service=service, id=ident, life="0123456789ab", protocol=1, config="f"
            )
            expected = may_announce(who, service, ident)
            assert allowed(who, "ingress", "liveliness_token", key) == expected, key
            assert allowed(who, "egress", "liveliness_token", key)
        everybody = pattern.split("{service}")[0].format(run="demo") + "**"
        assert allowed(who, "ingress", "liveliness_query", everybody)
        assert allowed(who, "ingress", "declare_liveliness_subscriber", everybody)


@EACH
def test_nothing_is_allowed_on_wide_keys_and_nothing_may_be_deleted(who: Credential) -> None:
    for key in ("**", "demo/**", "*/**", "demo/*/*/*", "@/**"):
        for flow in ("ingress", "egress"):
            for message in ("put", "delete", "query", "reply", "declare_queryable"):
                assert not allowed(who, flow, message, key), (flow, message, key)
            assert not allowed(who, flow, "declare_subscriber", key)
            assert not allowed(who, flow, "liveliness_token", key)
    assert not any("delete" in rule["messages"] for rule in ACL["rules"])


def test_a_driver_sends_under_its_own_robot_only() -> None:
    driver = Credential("driver", ("alpha",))
    common = {stream.wildcard("*") for stream in STREAMS if "{id}" not in stream.pattern}
    for message in ("put", "reply", "declare_queryable"):
        keys = [
            key
            for rule in access_control([driver])["rules"]
            if rule["flows"] == ["ingress"] and rule["messages"] == [message]
            for key in rule["key_exprs"]
            if key not in common
        ]
        assert keys
        assert all(key.startswith(("*/robot/alpha/", "*/service/driver-alpha/")) for key in keys)


def test_clients_are_told_of_who_hears_and_answers_them() -> None:
    """Without that, Zenoh's clients send nothing: not to a subscriber of all robots either."""
    driver, actor = Credential("driver", ("alpha",)), Credential("actor", ("alpha",))
    everybody = OBSERVATION.wildcard("demo")
    assert allowed(driver, "egress", "declare_subscriber", everybody)
    assert not allowed(driver, "ingress", "declare_subscriber", everybody)
    assert allowed(actor, "egress", "declare_queryable", EPISODE.wildcard("demo"))


def test_who_is_not_on_the_list_may_do_nothing() -> None:
    assert ACL["enabled"] is True
    assert ACL["default_permission"] == "deny"
    assert {rule["permission"] for rule in ACL["rules"]} == {"allow"}
    assert [s["cert_common_names"] for s in access_control([])["subjects"]] == []


def test_sizes_are_those_of_the_table() -> None:
    limits = {
        (limit["messages"][0], limit["key_exprs"][0]): limit["size_limit"]
        for limit in size_limits()
    }
    for stream in STREAMS:
        message = "put" if stream.delivery == "latest" else "query"
        assert limits[message, stream.wildcard("*")] == stream.max_bytes
    assert limits["query", EPISODE.wildcard("*")] == 24 * MIB
    assert limits["reply", EPISODE.wildcard("*")] == REPLY_LIMIT


@pytest.mark.parametrize(
    ("credential", "name"),
    [
        (Credential("replay"), "replay"),
        (Credential("driver", ("alpha",)), "driver-alpha"),
        (Credential("actor", ("alpha", "b-c")), "actor-alpha.b-c"),
        (Credential("operator", ("anna",)), "operator-anna"),
    ],
)
def test_names_of_credentials(credential: Credential, name: str) -> None:
    check(credential)
    assert credential.name == name


@pytest.mark.parametrize(
    ("credential", "complaint"),
    [
        (Credential("king"), "role: expected one of driver, actor"),
        (Credential("driver"), "driver: expected one robot as names, got 0"),
        (Credential("driver", ("a", "b")), "driver: expected one robot as names, got 2"),
        (Credential("replay", ("a",)), "replay: expected none as names, got 1"),
        (Credential("actor", ("../x",)), "actor: expected a name like"),
        (Credential("actor", ("a" * 30, "b" * 30)), "actor: expected names of 50 characters"),
        (Credential("driver", ("*",)), "driver: expected a name like"),
    ],
)
def test_credentials_that_make_no_sense_are_refused(credential: Credential, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint.replace("*", r"\*")):
        check(credential)
