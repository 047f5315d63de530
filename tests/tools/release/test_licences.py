"""Licences of what flockd runs with: all on the list. And what the check refuses."""

from __future__ import annotations

import pytest

from tools.release.licences import Licence, expression_of, is_allowed, licence_of, runtime_packages


@pytest.mark.parametrize("package", runtime_packages())
def test_every_run_time_package_has_a_licence_of_the_list(package: str) -> None:
    problem = licence_of(package).problem
    assert problem is None, problem


def test_what_is_checked_is_what_is_needed() -> None:
    assert {"numpy", "eclipse-zenoh", "pydantic-core", "flatbuffers", "mdurl"} <= set(runtime_packages())
    assert not {"pytest", "torch", "pymavlink"} & set(runtime_packages())


REFUSED = (
    "GPL-3.0-only", "GPL-2.0-or-later", "AGPL-3.0-only", "MIT AND GPL-3.0-only", "LicenseRef-Proprietary", "MIT AND",
    "(MIT OR Apache-2.0) AND GPL-3.0-only", "(MIT", "",
)  # fmt: skip
ALLOWED = (
    "MIT", "GPL-3.0-only OR MIT", "(GPL-3.0-only OR MIT) AND 0BSD", "Apache-2.0 WITH LLVM-exception AND MIT",
)  # fmt: skip


@pytest.mark.parametrize("expression", [*REFUSED, *ALLOWED])
def test_a_licence_is_allowed_where_it_can_be_chosen_from_the_list(expression: str) -> None:
    assert is_allowed(expression) == (expression in ALLOWED)


def test_metadata_of_every_kind_are_read() -> None:
    osi = "License :: OSI Approved :: "
    assert expression_of("one", "MIT", [f"{osi}Apache Software License"], None) == "MIT"
    assert expression_of("one", None, ["Topic :: X", f"{osi}MIT License"], "whatever") == "MIT"
    assert expression_of("one", None, [], "Apache 2.0") == "Apache-2.0"
    gpl = expression_of("one", None, [f"{osi}MIT License", f"{osi}GNU General Public License v3 (GPLv3)"], None)
    assert not is_allowed(gpl), "of several classifiers all have to be fulfilled"


@pytest.mark.parametrize("text", [None, "", "Copyright (c) 2001\nAll rights reserved."])
def test_an_unknown_licence_is_refused_by_the_name_of_its_package(text: str | None) -> None:
    licence = Licence("some-package", "1.2", expression_of("some-package", None, ["Topic :: X"], text))
    assert licence.problem == (
        "some-package 1.2: its licence is unknown; read it, and state it in tools/release/licences.py"
    )
