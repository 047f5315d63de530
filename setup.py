"""Puts `config/`, `models/` and `systemd/` into the wheel, as `flockd/_data/`; everything else is in pyproject.toml."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithData(build_py):
    """An editable install finds the folders in the checkout and needs no copies."""

    def run(self) -> None:
        """Builds the package, then copies the folders into it."""
        super().run()
        if not self.editable_mode:
            for folder in ("config", "models", "systemd"):
                target = Path(self.build_lib) / "flockd" / "_data" / folder
                shutil.copytree(folder, target, dirs_exist_ok=True)


# A path, not a finder: a script beside the clone would find the clone's folder before the package.
setup(cmdclass={"build_py": BuildWithData}, options={"editable_wheel": {"mode": "compat"}})
