"""The tool that asks what the tests would miss: its samples, its edits, its list of excuses."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.mutation.__main__ import ROOT, Score, reasons, sample, told
from tests.mutation.again import edited
from tests.mutation.modules import MODULES

SOURCE = """def first(a):
    return a + 1


class Thing:
    def first(self, a):
        b = 2
        return a + 1
"""
DIFF = "-    return a + 1\n+    return a - 1"


def test_every_module_and_every_test_of_it_is_there() -> None:
    for module, tests in MODULES.items():
        for path in (module.replace(".", "/") + ".py", *tests):
            assert (ROOT / path).exists(), path


def test_a_sample_is_the_same_for_the_same_seed_and_in_order() -> None:
    names = [f"m{n}" for n in range(100)]
    chosen = sample(names, count=10, seed=0)
    assert chosen == sample(names, count=10, seed=0) == sorted(chosen, key=names.index)
    assert len(set(chosen)) == 10 and chosen != sample(names, count=10, seed=1)
    assert sample(names[:5], count=10, seed=0) == names[:5]


def test_an_edit_is_made_in_the_mutant_s_own_function() -> None:
    first = edited(SOURCE, "m.x_first__mutmut_1", DIFF)
    assert first == SOURCE.replace("    return a + 1\n\n", "    return a - 1\n\n")
    method = edited(SOURCE, "m.x\u01c1Thing\u01c1first__mutmut_2", DIFF)
    assert method.endswith("        return a - 1\n") and method.startswith(SOURCE[:20])
    left_out = edited(SOURCE, "m.x\u01c1Thing\u01c1first__mutmut_3", "-    b = 2")
    assert left_out == SOURCE.replace("        b = 2\n", "")


def test_an_edit_that_has_no_place_is_refused() -> None:
    for mutant, diff in (("m.x_other__mutmut_1", DIFF), ("m.x_first__mutmut_1", "-    return 7\n+    return 8")):
        with pytest.raises(ValueError):
            edited(SOURCE, mutant, diff)


def test_a_module_is_made_of_the_text_that_is_given_and_nothing_on_disk_changes() -> None:
    code = (
        "from tests.mutation.imports import put_in_place_of\n"
        "finder = put_in_place_of('runtime.optics.pupil', compile('PUPIL_DIAMETERS = 7.0', 'x', 'exec'))\n"
        "from runtime.optics import pupil\n"
        "assert pupil.PUPIL_DIAMETERS == 7.0 and finder.used\n"
        "try: put_in_place_of('runtime.optics.pupil', compile('', 'x', 'exec'))\n"
        "except RuntimeError: pass\n"
        "else: raise SystemExit('a module that is there already was replaced')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_an_excuse_is_for_a_line_that_is_there_and_says_why() -> None:
    text = " ".join(" ".join((ROOT / (m.replace(".", "/") + ".py")).read_text().split()) for m in MODULES)
    for diff, why in reasons().items():
        assert diff.removeprefix("-").split(" +")[0].strip() in text, f"no longer there: {diff}"
        assert len(why) > 10


def test_the_score_is_of_the_mutants_that_change_something() -> None:
    excuse = next(iter(reasons()))
    table = told([Score("a.module", 100, 10, {"one": excuse, "two": "-    x\n+    y"})])
    assert "| a.module | 100 | 10 | 8 | 1 | 1 | 89 % |" in table
