"""Other points of interest: a new colour, a new shape, and four of them instead of three.

    python examples/new_classes.py --preset smoke --out runs/new-classes

takes every option of `python -m jaxsense.train`.
"""

import dataclasses

from jaxsense import Config, Shape, train


def change(config: Config) -> Config:
    """The settings of a preset, with other points of interest."""
    arena = config.arena
    return dataclasses.replace(
        config,
        arena=dataclasses.replace(
            arena,
            num_pois=4,
            # A colour is the linear RGB of its surface. "blue" is there already, as are "red",
            # "green" and "yellow".
            colours={**arena.colours, "orange": (0.9, 0.4, 0.05)},
            # A shape is an upright cylinder or a box, in shares of the largest PoI's radius.
            shapes={**arena.shapes, "post": Shape("cylinder", half_sides=(0.5, 0.5))},
            classes=("blue cylinder", "orange cylinder", "orange cube", "orange post"),
        ),
    )


if __name__ == "__main__":
    train.main(change=change)
