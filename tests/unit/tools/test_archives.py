"""Archives of runs: small, replaced seed by seed, and never trusted further than they are read."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest

from experiments.report.run_folder import load
from shared.errors import ConfigError, StateError
from tests.synthetic_runs import write_run
from tools import archives

NAME = "plus-rmm"


def archive(path: Path, *members: tuple[tarfile.TarInfo, bytes]) -> Path:
    with tarfile.open(path, "w:xz") as file:
        for member, data in members:
            member.size = len(data)
            file.addfile(member, io.BytesIO(data))
    return path


def test_runs_are_the_same_from_an_archive(tmp_path: Path) -> None:
    for seed in (1, 2):
        folder = write_run(tmp_path / "runs", NAME, seed)
        (folder / "tours.json").write_text("[]")
    archives.keep([tmp_path / "runs"], tmp_path / "kept", arrays=True)
    (path,) = (tmp_path / "kept").iterdir()
    assert path.name == "plus-rmm-tenth.tar.xz"
    (ours,), (theirs,) = load([tmp_path / "runs"]), archives.load([path])
    assert [run.info for run in ours.runs] == [run.info for run in theirs.runs]
    assert [run.episodes for run in ours.runs] == [run.episodes for run in theirs.runs]
    assert [run.evaluations for run in ours.runs] == [run.evaluations for run in theirs.runs]
    assert [len(run.probes) for run in theirs.runs] == [len(ours.runs[0].probes), 0]


def test_predictions_are_kept_only_if_asked_for_and_of_the_lowest_seed(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_run(tmp_path / "runs", NAME, seed)
    for arrays in (True, False):
        archives.keep([tmp_path / "runs"], tmp_path / "kept", arrays=arrays)
        names = archives.read(tmp_path / "kept" / "plus-rmm-tenth.tar.xz")
        assert any(n.startswith("seed-1/probes-") for n in names) == arrays
        assert [n for n in names if n.startswith("seed-2/")] == [
            "seed-2/episodes.csv", "seed-2/evaluations.csv", "seed-2/run.json",
        ]  # fmt: skip


def test_keeping_a_seed_again_replaces_it_and_leaves_the_others(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_run(tmp_path / "a", NAME, seed)
    archives.keep([tmp_path / "a"], tmp_path / "kept", arrays=False)
    write_run(tmp_path / "b", NAME, 1, commit="newer")
    archives.keep([tmp_path / "b"], tmp_path / "kept", arrays=False)
    (found,) = archives.load((tmp_path / "kept").iterdir())
    assert [run.info.commit for run in found.runs] == ["newer", "0123abc"]


def test_equal_runs_give_equal_archives(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", NAME, 1)
    for folder in ("a", "b"):
        archives.keep([tmp_path / "runs"], tmp_path / folder, arrays=True)
    first, second = (next((tmp_path / folder).iterdir()).read_bytes() for folder in ("a", "b"))
    assert first == second


def test_too_much_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "runs", NAME, 1)
    archives.keep([tmp_path / "runs"], tmp_path / "kept", arrays=False)
    (path,) = (tmp_path / "kept").iterdir()
    before = path.read_bytes()
    monkeypatch.setattr(archives, "KEPT_BYTES", len(before) + 1000)
    write_run(tmp_path / "runs", NAME, 2)
    with pytest.raises(ConfigError, match="keep fewer runs"):
        archives.keep([tmp_path / "runs"], tmp_path / "kept", arrays=False)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "name", ["../run.json", "/run.json", "seed-1/../run.json", "seed-1/a/b", "seed-1/.hidden", "x"]
)
def test_members_outside_the_folders_of_seeds_are_refused(tmp_path: Path, name: str) -> None:
    path = archive(tmp_path / "bad.tar.xz", (tarfile.TarInfo(name), b"{}"))
    with pytest.raises(StateError, match="expected files of seeds"):
        archives.load([path])


def test_links_are_refused(tmp_path: Path) -> None:
    link = tarfile.TarInfo("seed-1/run.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/hostname"
    with pytest.raises(StateError, match="expected files of seeds"):
        archives.read(archive(tmp_path / "bad.tar.xz", (link, b"")))


def test_files_too_large_together_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = archive(tmp_path / "bad.tar.xz", (tarfile.TarInfo("seed-1/run.json"), b"1" * 20_000))
    assert archives.read(path)
    monkeypatch.setattr(archives, "UNPACKED_BYTES", 20_000)
    with pytest.raises(StateError, match="at most 20000 bytes"):
        archives.read(path)


def test_a_damaged_archive_is_named(tmp_path: Path) -> None:
    path = archive(tmp_path / "bad.tar.xz", (tarfile.TarInfo("seed-1/run.json"), b"{}" * 1000))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StateError, match=r"bad\.tar\.xz"):
        archives.read(path)
    path.write_bytes(b"no archive")
    with pytest.raises(StateError, match=r"bad\.tar\.xz"):
        archives.read(path)
