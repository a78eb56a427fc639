"""The router's configuration, for zenohd too: who may connect and do what. It holds keys."""

import json
from base64 import b64encode
from pathlib import Path

from services.security.authority import ROUTER, Authority, write_private
from services.security.rules import access_control, size_limits
from shared.keys import MIB
from shared.zenoh_settings import zenoh_config

FILE = "router.json5"
LISTEN = "tls/0.0.0.0:7447"
AS_ALWAYS = ("mode", "connect", "listen", "scouting", "transport", "adminspace")
LARGEST = 32 * MIB
"""The router puts together no larger message, whatever its key."""


def write(authority: Authority) -> Path:
    """Write the router's configuration for those who are on the roster now."""
    folder = authority.folder / ROUTER
    plain = zenoh_config("router", listen=[LISTEN])
    settings = {key: json.loads(plain.get_json(key)) for key in AS_ALWAYS}
    settings["transport"]["link"]["rx"]["max_message_size"] = LARGEST
    settings["transport"]["link"]["tls"] = {
        "root_ca_certificate_base64": _base64(authority.trusted.encode()),
        "listen_private_key_base64": _base64((folder / "key.pem").read_bytes()),
        "listen_certificate_base64": _base64((folder / "cert.pem").read_bytes()),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    settings["access_control"] = access_control(list(authority.credentials.values()))
    settings["low_pass_filter"] = size_limits()
    head = "// Made by `corridor secure`; made anew whenever a credential is added or revoked.\n"
    write_private(folder / FILE, (head + json.dumps(settings, indent=1) + "\n").encode())
    return folder / FILE


def _base64(data: bytes) -> str:
    return b64encode(data).decode()
