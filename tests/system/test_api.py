# SPDX-License-Identifier: Apache-2.0
"""API.md lists the interface as it is: what the code has and the page lacks, or the reverse, is a failure."""

import interface

import csplat
import csplat_render
import csplat_tools
import csplat_trainer


def test_the_page_lists_the_interface_of_the_code():
    known, made = interface.PAGE.read_text("utf-8"), interface.page()
    assert known == made, "if the change is meant: python tests/helpers/interface.py"
    assert known.startswith("# The interface of csplat 1\n")


def test_members_that_are_not_promised_exist():
    classes = {
        name: getattr(package, name)
        for package in (csplat, csplat_render, csplat_tools, csplat_trainer)
        for name in package.__all__
    }
    for name, members in interface.INTERNAL.items():
        known = {*dir(classes[name]), *getattr(classes[name], "__dataclass_fields__", ())}
        assert set() == set(members.split()) - known, name


def test_changes_show():
    made = interface.page()
    for entry in (
        "encode(scene,options,out,target,views,importance,levels,context)", "Camera{H,K,W,", "`csplat_decode()`",
        "CsplatReader{", "`firstpicture`", "`--target-psnr`", "declared_errors{", "csplat_error{code,",
    ):  # fmt: skip
        assert entry in made
    assert "thread_count" not in made.partition("\n## JavaScript")[0]
