"""Which modules are mutated, and the narrow tests that must notice."""

from __future__ import annotations

# module -> its own tests
MODULES: dict[str, tuple[str, ...]] = {
    "runtime.optics.rpu": ("tests/optics/test_rpu.py",),
    "runtime.optics.malus": ("tests/optics/test_malus.py",),
    "runtime.optics.alignment": ("tests/optics/test_alignment.py",),
    "runtime.optics.views": ("tests/optics/test_views.py",),
    "runtime.optics.carried": ("tests/optics/test_carried.py",),
    "runtime.optics.pupil": ("tests/optics/test_pupil.py",),
    "runtime.model.chain": ("tests/model/test_chain.py",),
    "runtime.model.pyramid_level": ("tests/model/test_pyramid_level.py",),
    "runtime.model.sart": ("tests/model/test_sart.py",),
    "runtime.eyes.tracker": ("tests/eyes/test_tracker.py", "tests/eyes/test_imm.py"),
    "runtime.eyes.calibration": ("tests/eyes/test_calibration_file.py",),
    "calib.similarity": ("tests/calib/test_similarity.py", "tests/calib/test_similarity_numerics.py"),
    "calib.solution": ("tests/calib/test_solution.py",),
    "runtime.panels.presentation": ("tests/panels/test_offscreen.py",),
}
