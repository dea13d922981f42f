"""What cannot be used is refused: settings to change, and the form of every message."""

import dataclasses
import math
import re
from typing import get_type_hints

from hypothesis import strategies as st

from jaxsense import PRESETS

SMOKE = PRESETS["smoke"]
NAN, INF = math.nan, math.inf
SECTIONS = {
    field.name: getattr(SMOKE, field.name)
    for field in dataclasses.fields(SMOKE)
    if dataclasses.is_dataclass(getattr(SMOKE, field.name))
}
FIELDS = [(name, f) for name, section in SECTIONS.items() for f in dataclasses.fields(section)]
# With those of a section within a section.
PARTS = {
    **SECTIONS,
    "mission.localisation": SMOKE.mission.localisation,
    "mission.communication": dataclasses.replace(SMOKE.mission.communication, own_maps=True),
}
NUMBERS = [
    (name, field)
    for name, section in PARTS.items()
    for field, kind in get_type_hints(type(section)).items()
    if kind in (int, float)
]


def check_message(text: str) -> None:
    """One line of the form `field = value: what would be right`, or `value of what is wrong`."""
    assert "\n" not in text
    assert len(text) < 900
    text = re.sub(r"^(jaxsense\.\w+|benchmarks): ", "", text)
    assert re.match(r"\S+ .+: \S+", text), text


ANYTHING = st.one_of(
    st.floats(), st.integers(), st.text(max_size=5), st.none(), st.booleans(),
    st.lists(st.integers(-2, 2), max_size=3), st.lists(st.floats(), max_size=3).map(tuple),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)  # fmt: skip
