"""How sessions of ours are configured. It imports Zenoh alone, so that a stop is quick."""

import json
import logging
import re
from collections.abc import Sequence

import zenoh

log = logging.getLogger(__name__)


def zenoh_config(
    mode: str,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    lease_ms: int = 2000,
    shared_memory: bool = False,
    credentials: str = "",
) -> zenoh.Config:
    """A closed configuration: no scouting, quick reconnection, encryption with credentials."""
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "connect/endpoints": [encrypted(end) if credentials else end for end in connect],
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "connect/timeout_ms": 1000,
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 300,
            "period_increase_factor": 1.5,
        },
        "transport/link/tx/lease": lease_ms,
        # It would go around encryption.
        "transport/shared_memory/enabled": shared_memory and not credentials,
        "adminspace/enabled": mode == "router",
        **({"transport/link/tls": _tls(credentials)} if credentials else {}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def opened(config: zenoh.Config) -> zenoh.Session:
    """A session; without shared memory where there is no room for it. Raises ZError."""
    try:
        return zenoh.open(config)
    except BaseException as error:  # a panic of Zenoh is no Exception
        if "shm" not in str(error).lower():
            raise
        log.warning("messages go without shared memory: %s", error)
        config.insert_json5("transport/shared_memory/enabled", "false")
        return zenoh.open(config)


def locator(session: zenoh.Session, endpoint: str) -> str:
    """Where a session in router mode really listens: `endpoint` with its port filled in."""
    replies = session.get(f"@/{session.zid()}/router", timeout=5.0)
    answers = [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]
    return str(answers[0]["locators"][0]) if answers and answers[0]["locators"] else endpoint


def _tls(credentials: str) -> dict[str, object]:
    return {
        "root_ca_certificate": f"{credentials}/ca.pem",
        "connect_private_key": f"{credentials}/key.pem",
        "connect_certificate": f"{credentials}/cert.pem",
        "enable_mtls": True,
    }


def encrypted(endpoint: str) -> str:
    """The same endpoint with TLS."""
    return re.sub("^tcp/", "tls/", endpoint)
