"""Rules about the code as a whole that no single module can keep."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("shared", "services", "experiments")


def imports() -> Iterator[tuple[str, str]]:
    """(file, imported top-level package) of all our code, imports inside functions included."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module]
                for name in names:
                    yield str(path.relative_to(ROOT)), name.split(".")[0]


def importers(module: str) -> set[str]:
    """Files with `from module import ...`."""
    return {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if f"from {module} import" in path.read_text()
    }


def users(package: str) -> set[str]:
    return {file for file, name in imports() if name == package}


def test_zenoh_is_imported_by_our_buses_and_by_the_first_stop_alone() -> None:
    """Two sessions with nothing in common but the library: see the head of each."""
    assert users("zenoh") == {
        "shared/bus.py",
        "shared/foreign_bus.py",
        "shared/zenoh_settings.py",
        "services/cli/first_stop.py",
    }
    assert importers("shared.foreign_bus") == {
        "services/robot_driver/real/ros2.py",
        "services/robot_driver/real/ros2_sensors.py",
        "services/robot_driver/emulation/ros2.py",
        "services/robot_driver/emulation/ros2_faults.py",
        "services/robot_driver/emulation/ros2_network.py",
    }


def test_one_file_imports_rosbags() -> None:
    assert users("rosbags") == {"services/robot_driver/real/ros2_types.py"}


def test_one_file_imports_pybullet() -> None:
    assert users("pybullet") == {"services/robot_driver/simulated/scene.py"}


def test_one_file_imports_simplejpeg() -> None:
    assert users("simplejpeg") == {"services/robot_driver/real/picture.py"}


def test_one_file_imports_cryptography() -> None:
    assert users("cryptography") == {"services/security/authority.py"}


def test_one_file_imports_lmdb() -> None:
    assert users("lmdb") == {"services/replay/tables.py"}


def test_nothing_that_executes_what_it_reads() -> None:
    for forbidden in ("pickle", "cloudpickle", "shelve", "marshal", "dill"):
        assert users(forbidden) == set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call):
                    called = ast.unparse(node.func)
                    assert called not in {"eval", "exec", "torch.load"}, path


def test_the_algorithm_has_no_clock_socket_file_logger_or_environment() -> None:
    used = {(file, name) for file, name in imports() if file.startswith("shared/rl/")}
    # A row of the table of strategies names the file to import, so that the table needs no library.
    used.remove(("shared/rl/retention/strategy.py", "importlib"))
    assert {name for _, name in used} <= {
        "__future__", "abc", "collections", "concurrent", "contextlib", "copy", "dataclasses",
        "hashlib", "json", "math", "typing",
        "cv2", "numpy", "openvino", "safetensors", "torch", "shared",
    }  # fmt: skip


def test_the_driver_on_hardware_needs_no_torch() -> None:
    for file in users("torch"):
        assert not file.startswith(("services/robot_driver", "services/router", "services/monitor"))
