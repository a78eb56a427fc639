"""Modules of ours whose libraries come with an extra of the package, and may not be installed."""

import importlib
import sys
from typing import Any

from shared.errors import ConfigError


def import_installed(module: str, extra: str) -> Any:
    """Import a module of ours that needs the libraries of an extra. Raises ConfigError."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in {"experiments", "services", "shared"}:
            raise
        remedy = f"pip install 'corridor[{extra}]'"
        if error.name == "pybullet" and sys.version_info >= (3, 12):
            remedy = "it has no wheels for this Python, use Python 3.11"
        raise ConfigError(
            f"{extra}: needs the Python package {error.name}, which is not installed: {remedy}"
        ) from error
