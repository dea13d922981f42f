import pytest
from arenas import arena, known_layout, place, set_native  # noqa: F401

from jaxsense.sim import raycast


@pytest.fixture(params=["_nearest_by_one_loop", "_nearest_by_two_loops"])
def by(request, monkeypatch):
    """Both ways to find what is nearest, that of accelerators and that of CPUs."""
    find = getattr(raycast, request.param)
    for name in ("_nearest_by_one_loop", "_nearest_by_two_loops"):
        monkeypatch.setattr(raycast, name, find)
    return request.param
