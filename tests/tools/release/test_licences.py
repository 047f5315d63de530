"""Licences of what flockd runs with: all on the list. And what the check refuses."""

from __future__ import annotations

import re
from importlib.metadata import distributions

import pytest

from tools.release.licences import ALLOWED, installed, problems
from tools.release.wheels import names_of_lock

BAGS = ("rosbags", "ruamel-yaml")
"""What the extra `bags` brings, with what says its licence; apsw's LICENSE file alone says Zlib's terms."""
ROS = {"ros-fastdds", "ros-fastcdr", "ros-wheels-bootstrapper"}
"""Apache-2.0, by the LICENSE files of the first two and the metadata of the last, which has no package.xml."""
SAID = {"Apache License, Version 2.0", "Apache 2.0", "BSD", "BSD-3-Clause", "3-Clause BSD License"}
"""As the package.xml of ROS have it."""


def test_every_run_time_package_has_a_licence_of_the_list() -> None:
    assert problems([*names_of_lock(), *BAGS], installed()) == []


@pytest.mark.parametrize(
    "said", ["GPL-3.0-only", "MIT AND GPL-3.0-only", "MIT License; GNU General Public License v3 (GPLv3)", "UNKNOWN"]
)
def test_others_are_refused_by_the_name_of_their_package(said: str) -> None:
    """Of several classifiers all have to be fulfilled."""
    assert [problem.partition(" is ")[0] for problem in problems(["one", "two"], {"one": said, "two": "MIT"})] == [
        f"one: {said}"
    ]


def test_a_package_that_is_not_installed_is_told() -> None:
    assert [problem.split()[0] for problem in problems(["absent"], {})] == ["absent"]


@pytest.mark.ros
def test_wheels_of_ros_are_on_the_list_too() -> None:
    """Their metadata say nothing, the package.xml that they bring does."""
    said = {
        one.metadata["Name"]: {
            licence
            for file in one.files or ()
            if file.name == "package.xml"
            for licence in re.findall(r"<license[^>]*>([^<]+)</license>", one.locate_file(file).read_text())
        }
        for one in distributions()
        if one.metadata["Name"].startswith("ros-")
    }
    assert said, "no wheel of ROS is installed"
    assert {name for name, found in said.items() if not found or found - ALLOWED - SAID} <= ROS
