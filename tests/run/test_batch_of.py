"""How many missions play side by side."""

import pytest

from jaxsense.run import devices, missions
from jaxsense.run.devices import Workers

GIB = 2**30
TWO = lambda: Workers(threads=2)  # noqa: E731
MESH = lambda: Workers(mesh=devices.make_mesh(2))  # noqa: E731


@pytest.mark.parametrize(
    ("memory", "total", "workers", "expected"),
    [
        # On a CPU at most a third at once, and what the caches of each thread hold.
        (None, 10_000, Workers, 192),
        (None, 10_000, TWO, 384),
        (None, 30, TWO, 10),
        (None, 1, Workers, 1),
        (80 * GIB, 100, Workers, 100),  # all
        (80 * GIB, 32_768, Workers, 16_384),  # sqrt(8192 * 32,768)
        (80 * GIB, 10**6, Workers, 32_768),  # no more pay
        (8 * GIB, 10**6, Workers, 8_192),  # of 1 MiB each
        (80 * GIB, 10**7, MESH, 65_536),
        (80 * GIB, 32_768, MESH, 23_170),  # sqrt(8192 * 32,768 * 2)
    ],
)
def test_as_many_missions_play_side_by_side_as_pay_and_fit(
    memory, total, workers, expected, monkeypatch
):
    monkeypatch.setattr(devices, "memory", lambda: memory)
    assert missions.batch_of(total, workers()) == expected
