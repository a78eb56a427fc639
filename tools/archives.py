"""Runs kept with the code: one compressed archive per experiment, with the files figures need.

An archive is a tar file compressed with xz. Its members are called `seed-<n>/<file>`; files are
those that a run writes (`experiments/records.py`).
"""

import io
import lzma
import re
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from experiments.report import run_folder
from experiments.report.run_folder import Experiment, RunFolder
from shared.errors import ConfigError, StateError

SUFFIX = ".tar.xz"
TABLES = ("run.json", "evaluations.csv", "episodes.csv", "tours.json")
MEMBER = re.compile(r"seed-\d{1,9}/[^/\\.][^/\\]*")
UNPACKED_BYTES = 100_000_000
"""An archive whose files are larger together is refused."""
KEPT_BYTES = 2_500_000
"""All archives together may have this size: a repository is no warehouse."""

Files = Mapping[str, bytes]
"""Contents of an archive by member name."""


def keep(runs: Sequence[Path], folder: Path, *, arrays: bool) -> None:
    """Add runs to the archives of their experiments. A seed that is there already is replaced.

    arrays: Whether predictions and routes of the lowest seed are kept as well. Figures of images
        and of drives need them; they take most of an archive's size.

    Raises:
        ConfigError: A folder holds no run, or the archives would be larger than KEPT_BYTES.
            Nothing is written then.
        StateError: A run or an archive is damaged.
    """
    packed: dict[Path, bytes] = {}
    for experiment in run_folder.load(runs):
        path = folder / f"{experiment.full_name}{SUFFIX}"
        files = dict(read(path)) if path.exists() else {}
        for run in experiment.runs:
            start = f"seed-{run.info.seed}/"
            files = {name: data for name, data in files.items() if not name.startswith(start)}
            of_run = _small_files(run, arrays=arrays and run is experiment.runs[0])
            files |= {start + name: data for name, data in of_run.items()}
        packed[path] = _packed(files)
    others = (path.stat().st_size for path in folder.glob(f"*{SUFFIX}") if path not in packed)
    total = sum(others) + sum(len(data) for data in packed.values())
    if total > KEPT_BYTES:
        raise ConfigError(
            f"{folder}: expected at most {KEPT_BYTES / 1e6:.1f} MB of archives, got "
            f"{total / 1e6:.1f} MB; keep fewer runs"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for path, data in packed.items():
        path.write_bytes(data)


def _small_files(run: RunFolder, *, arrays: bool) -> dict[str, bytes]:
    names = [name for name in TABLES if (run.folder / name).exists()]
    names += [path.name for path in sorted(run.folder.glob("*.npz"))] if arrays else []
    return {name: (run.folder / name).read_bytes() for name in names}


def _packed(files: Files) -> bytes:
    """An archive without times and owners, so that equal files give equal bytes."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:xz", preset=9) as archive:
        for name, data in sorted(files.items()):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return packed.getvalue()


def read(path: Path) -> Files:
    """The files of an archive, checked before any of them is read.

    Raises:
        StateError: The archive is damaged, a member is no plain file of a seed, or all of them
            together are larger than UNPACKED_BYTES.
    """
    files, total = {}, 0
    decompressor = lzma.LZMADecompressor()
    try:
        data = decompressor.decompress(path.read_bytes(), UNPACKED_BYTES)
        if not decompressor.eof:
            raise StateError(f"{path}: expected a whole archive of at most {UNPACKED_BYTES} bytes")
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                total += member.size
                content = archive.extractfile(member) if member.isreg() else None
                if content is None or not MEMBER.fullmatch(member.name):
                    raise StateError(f"{path}: expected files of seeds, got {member.name!r}")
                if total > UNPACKED_BYTES:
                    raise StateError(f"{path}: expected at most {UNPACKED_BYTES} bytes of files")
                files[member.name] = content.read()
    except (OSError, EOFError, tarfile.TarError, lzma.LZMAError) as error:
        raise StateError(f"{path}: {error}") from error
    return files


def load(paths: Iterable[Path]) -> list[Experiment]:
    """The experiments of archives, as `run_folder.load` gives them. Raises StateError: damaged."""
    with TemporaryDirectory(prefix="corridor-results-") as temporary:
        folders = []
        for path in paths:
            folders.append(Path(temporary) / path.name.removesuffix(SUFFIX))
            for name, data in read(path).items():
                file = folders[-1] / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
        return run_folder.load(folders)
