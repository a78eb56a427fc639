"""What a credential may do on the bus: allow-lists for the router, made from the table of streams.

A row of the table says which roles send and which receive, and a credential may do that under its
own names only: the driver of `alpha` sends under `robot/alpha`. It may also hear what it publishes
and ask what it answers, so that a health check inside a container needs no second credential. What
is not allowed here is refused by the router, silently.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from services.security.kinds import ANY, KINDS, Credential, Kind
from shared.bus import REPLY_LIMIT
from shared.keys import ALIVE_PATTERN, CLAIM_PATTERN, STREAMS, Role, Stream

Action = Literal[
    "publish", "subscribe", "ask", "answer", "token", "look", "see subscribers", "see queryables"
]
TOKENS = (ALIVE_PATTERN, CLAIM_PATTERN)
"""Liveliness tokens: a service declares those of its own names, and everybody may look."""

FLOWS: dict[Action, tuple[tuple[str, str], ...]] = {
    "publish": (("ingress", "put"),),
    "subscribe": (("ingress", "declare_subscriber"), ("egress", "put")),
    "ask": (("ingress", "query"), ("egress", "reply")),
    "answer": (("ingress", "declare_queryable"), ("ingress", "reply"), ("egress", "query")),
    "token": (("ingress", "liveliness_token"),),
    "look": (
        ("ingress", "liveliness_query"),
        ("ingress", "declare_liveliness_subscriber"),
        ("egress", "liveliness_token"),
    ),
    # A client that is not told of the other side sends nothing.
    "see subscribers": (("egress", "declare_subscriber"),),
    "see queryables": (("egress", "declare_queryable"),),
}
"""What Zenoh calls it: ingress is what the router takes from a client, egress what it sends."""


def rights(credential: Credential) -> frozenset[tuple[Action, str]]:
    """Everything a credential may do, each with the key expression it may do it on."""
    kind = KINDS[credential.kind]
    return frozenset(
        right
        for role in kind.roles
        for stream in STREAMS
        for right in _of_stream(stream, role, credential)
    ) | frozenset(_of_tokens(kind, credential))


def _of_stream(stream: Stream, role: Role, credential: Credential) -> Iterator[tuple[Action, str]]:
    own = _keys(stream, role, credential, owner=True)
    others = _keys(stream, role, credential, owner=False)
    if stream.delivery == "latest":
        if role in stream.senders:
            yield ("see subscribers", stream.wildcard(ANY))
            yield from (("publish", key) for key in own)
            yield from (("subscribe", key) for key in own)
        if role in stream.receivers:
            yield from (("subscribe", key) for key in others)
    else:
        if role in stream.receivers:
            yield from (("answer", key) for key in own)
            yield from (("ask", key) for key in own)
            yield ("see queryables", stream.wildcard(ANY))
        if role in stream.senders:
            yield from (("ask", key) for key in others)
            yield ("see queryables", stream.wildcard(ANY))


def _keys(stream: Stream, role: Role, credential: Credential, *, owner: bool) -> list[str]:
    """Key expressions of a stream under the names of a credential, of every run."""
    idents = credential.idents if role in ("driver", "actor") else (ANY,)
    if stream.pattern.startswith("{run}/service/"):  # its id is <service>-<id>
        ours = (f"{role}-{ident.replace(ANY, '$*')}" for ident in credential.idents)
        idents = tuple(ours) if owner else (ANY,)
    return sorted({stream.pattern.format(run=ANY, id=ident) for ident in idents})


def _of_tokens(kind: Kind, credential: Credential) -> Iterator[tuple[Action, str]]:
    blanks = {"run": ANY, "life": ANY, "protocol": ANY, "config": ANY}
    for pattern in TOKENS:
        yield ("look", pattern.split("{service}")[0].format(run=ANY) + "**")
        for service in kind.services:
            for ident in credential.idents:
                yield ("token", pattern.format(service=service, id=ident, **blanks))


def access_control(credentials: Sequence[Credential]) -> dict[str, Any]:
    """Zenoh's `access_control`: allow-lists by the common name of the certificate."""
    names = sorted(credential.name for credential in credentials)
    rules = [rule for credential in credentials for rule in _rules(credential)]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in names],
        "policies": [
            {
                "rules": [rule["id"] for rule in rules if rule["id"].startswith(f"{name} ")],
                "subjects": [name],
            }
            for name in names
        ],
    }


def _rules(credential: Credential) -> Iterator[dict[str, Any]]:
    keys: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for action, key in rights(credential):
        for flow_and_message in FLOWS[action]:
            keys[flow_and_message].add(key)
    for (flow, message), allowed in sorted(keys.items()):
        yield {
            "id": f"{credential.name} {flow} {message}",
            "permission": "allow",
            "flows": [flow],
            "messages": [message],
            "key_exprs": sorted(allowed),
        }


def size_limits() -> list[dict[str, Any]]:
    """Zenoh's `low_pass_filter`: the router drops messages that receivers would refuse."""

    def limit(stream: Stream, message: str, size: int) -> dict[str, Any]:
        return {
            "id": f"{stream.name} {message}",
            "flows": ["ingress"],
            "messages": [message],
            "key_exprs": [stream.wildcard(ANY)],
            "size_limit": size,
        }

    limits = []
    for stream in STREAMS:
        message = "put" if stream.delivery == "latest" else "query"
        limits.append(limit(stream, message, stream.max_bytes))
        if message == "query":
            limits.append(limit(stream, "reply", REPLY_LIMIT))
    return limits
