"""`corridor doctor` names what is wrong with a machine and what to do, and ends with a verdict."""

from __future__ import annotations

import resource
import socket
from pathlib import Path

import pytest

from services.monitor import doctor
from shared.config import Config

ENDPOINT = "tcp/127.0.0.1:9"


def config(endpoint: str = ENDPOINT) -> Config:
    return Config.model_validate({"bus": {"endpoint": endpoint}})


def findings(folder: Path, endpoint: str = ENDPOINT) -> dict[str, doctor.Finding]:
    return {finding.what: finding for finding in doctor.examine(config(endpoint), folder)}


@pytest.fixture(autouse=True)
def few_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each one is imported in a process of its own, which takes a while."""
    monkeypatch.setattr(doctor, "LIBRARIES", {"pydantic": ""})
    monkeypatch.setattr(doctor, "_gpu", lambda: doctor.Finding("GPU", "none"))


def test_this_machine_is_ready(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.run(config(), tmp_path / "runs") == 0
    assert capsys.readouterr().out.rstrip().endswith("ready")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("limit", "what", "advice"),
    [
        (resource.RLIMIT_AS, "address space", "ulimit -v unlimited"),
        (resource.RLIMIT_NOFILE, "open files", "ulimit -n 4096"),
    ],
)
def test_a_limit_is_named_with_its_remedy(
    limit: int,
    what: str,
    advice: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = resource.getrlimit
    monkeypatch.setattr(resource, "getrlimit", lambda n: (512, 512) if n == limit else before(n))
    assert findings(tmp_path)[what].verdict == "bad"
    assert doctor.run(config(), tmp_path) == 1
    assert f"not ready: {advice}" in capsys.readouterr().out


def test_what_only_slows_down_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "SHARED", str(tmp_path / "none"))
    assert findings(tmp_path)[str(tmp_path / "none")].verdict == "slow"
    assert doctor.run(config(), tmp_path) == 0


def test_a_library_that_kills_its_process_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pydantic.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGILL)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = findings(tmp_path)["pydantic"]
    assert found.verdict == "bad"
    assert "cannot be imported: -4" in found.found


def test_a_missing_library_names_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LIBRARIES", {"no-such-package": "sim"})
    found = findings(tmp_path)["no-such-package"]
    assert (found.verdict, found.found) == ("good", "not installed (extra sim)")


def test_a_router_is_seen(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert findings(tmp_path, endpoint)[f"router, {endpoint}"].found == "somebody listens there"
    assert "nobody listens" in findings(tmp_path, endpoint)[f"router, {endpoint}"].found
    assert findings(tmp_path, "tcp/127.0.0.1:x")["router, tcp/127.0.0.1:x"].verdict == "bad"


def test_an_old_clock_and_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: 0.0)
    monkeypatch.setattr(doctor, "_free_bytes", lambda _: 1)
    found = findings(tmp_path)
    assert found["clock"].verdict == "bad"
    assert found[f"disk, {tmp_path}"].verdict == "bad"
