"""An old name states the new one, which exists; files of the last version keep the names of their arrays."""

from __future__ import annotations

import inspect
from dataclasses import fields, is_dataclass
from importlib import import_module

import numpy as np
import pytest
from results import make_result

from rgbmidic import correlation, frames, mesh, renamed, results, weights
from rgbmidic import fields as rgbmidic_fields
from rgbmidic.illumination import IlluminationImages
from rgbmidic.tools import finite_elements, report
from rgbmidic.tools.finite_elements import comparison, simulation
from rgbmidic.tools.lab import inspection

CLASSES = {
    "IlluminationImages": IlluminationImages,
    **vars(correlation),
    **vars(frames),
    **vars(rgbmidic_fields),
    **vars(weights),
    **vars(mesh),
    **vars(inspection),
    **vars(finite_elements),
    **vars(comparison),
    **vars(simulation),
    **vars(report),
    **vars(results),
}
OLD = [(owner, *pair) for owner, names in renamed._NAMES.items() for pair in names.items()]


@pytest.mark.parametrize(("owner", "old", "new"), OLD, ids=[f"{owner}.{old}" for owner, old, _ in OLD])
def test_an_old_name_states_the_new_one(owner, old, new):
    home = CLASSES[owner] if owner in CLASSES else import_module(owner)
    module, _, new = new.rpartition(".")
    with pytest.raises((AttributeError, ImportError), match=rf"{owner}\.{old} is now {module or owner}\.{new}$"):
        getattr(home, old)
    home = import_module(module) if module else home
    names = {field.name for field in fields(home)} if is_dataclass(home) else set()
    assert new in names or new in dir(home) or f"self.{new}" in inspect.getsource(home)


def test_other_names_are_unknown_as_ever():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        results.nothing  # noqa: B018


def test_a_record_names_its_arrays_as_the_last_version_did(tmp_path):
    result = make_result(tmp_path / "r", frames=1)
    with pytest.raises(AttributeError, match=r"Result\.exx is now Result\.nodal_exx"):
        _ = result.exx
    with np.load(next((tmp_path / "r" / "solution").glob("*.npz"))) as record:
        assert {"exx", "exy_std", "eyy_mesh_error"} <= set(record.files)
        np.testing.assert_array_equal(record["exx"], result.nodal_exx[0])
