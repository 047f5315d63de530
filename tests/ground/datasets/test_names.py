"""Names in a dataset's lists that cannot be paths; found by tools/checks/fuzz.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.ground.datasets import DatasetError, open_dataset


def test_a_name_that_cannot_be_a_path_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("1.0 rgb/a\0b.png\n", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"rgb/a\0b.png: cannot be read \(embedded null byte\); restore it"):
        open_dataset(tmp_path)
