"""The command writes the whole report, or refuses in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from services.cli.main import main
from tests.synthetic_runs import write_run

PNG = b"\x89PNG"


def test_the_command_writes_pages_that_need_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("policy-eps-greedy", "policy-roulette"):
        write_run(tmp_path / "runs", name, 1)
    out = tmp_path / "out"
    assert main(["report", str(tmp_path / "runs"), "--out", str(out)]) == 0
    assert "report.html and 5 Markdown pages" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert set(re.findall(r'(?:src|href)="([^"]{0,10})', page)) == {
        "data:image", "#runs", "#policy-ep", "#policy-ro", "#compariso", "#claims-te",
    }  # fmt: skip
    for path in out.glob("*.md"):
        for picture in re.findall(r"\]\((figures/[^)]+)\)", path.read_text()):
            assert (out / picture).read_bytes().startswith(PNG)


def test_the_command_refuses_a_folder_without_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "expected the folder of a run" in capsys.readouterr().err
