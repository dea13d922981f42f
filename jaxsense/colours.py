"""The colours of classes and robots in plots and animations."""

from jaxsense.config import ArenaConfig

ROBOT_COLOURS = ("#8250c8", "#d9700a", "#0891a8", "#7d8a12")


def class_colour(arena: ArenaConfig, label: str) -> tuple[float, float, float]:
    """The colour of a class, RGB in [0, 1]: its own, and half as bright for all shapes but one."""
    name, shape, *_ = label.split(" ")
    red, green, blue = arena.colours[name]
    brightness = 1.0 if shape == next(iter(arena.shapes)) else 0.5
    return brightness * red, brightness * green, brightness * blue


def as_hex(colour: tuple[float, float, float]) -> str:
    """RGB in [0, 1] as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)
