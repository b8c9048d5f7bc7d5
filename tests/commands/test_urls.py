"""No command fetches anything: a URL is refused wherever a file is asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
from refusals import refusal
from repository import DEMO

KEYS = ["logs.train=[s3://bucket/a.factor]", "logs.test=[memory://bucket/a.npz]", "robot.urdf=s3://bucket/a.urdf"]


@pytest.mark.parametrize("key", [*KEYS, "output=s3://b/run"])
def test_no_key_takes_a_url(tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str) -> None:
    message = refusal(["identify", str(DEMO / "quadruped.yaml"), key], tmp_path, capsys)
    assert ", a URL (download it first, with curl); accepted: a path" in message


def test_compress_writes_to_no_url(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refusal(["compress", str(DEMO / "quadruped.yaml"), "--output", "s3://bucket/factors"], tmp_path, capsys)
    assert message.startswith("torchid: s3://bucket/factors: output: a URL; accepted: a folder on this machine")
