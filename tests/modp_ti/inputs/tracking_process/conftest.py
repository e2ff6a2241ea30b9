"""The walk through the box room, as the tests of `klt` have it."""

from tests.modp_ti.inputs.klt.conftest import box_room, box_walk

__all__ = ["box_room", "box_walk"]
