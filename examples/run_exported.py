"""Runs the file of `python -m jaxsense.export` with onnxruntime, without JAX.

    python examples/run_exported.py runs/.../exported.zip

lets a run's robots explore the points of interest (PoIs) of one map: each asks its policy where to
look, and updates the map with what its sensor detects there. Real robots run `detect` on their
scans; here the features are made up. Copy this file, the archive and the `interfaces/robot.py` of
jaxsense, which plays it, to a robot. Robots with maps of their own tell each other what they have
seen; half of the messages are lost.
"""

import argparse
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Programs = dict[str, Callable[..., dict[str, np.ndarray]]]


def imported(name: str, package: str) -> Any:
    """A file of jaxsense: its copy next to this file, or else that of the installed package."""
    is_copied = Path(__file__).with_name(f"{name}.py").exists()
    try:
        return importlib.import_module(name if is_copied else f"{package}.{name}")
    except ModuleNotFoundError as error:
        absent = str(error.name).partition(".")[0]
        if absent in (name, "jaxsense"):
            sys.exit(f"needs {name}.py: copy it next to this file")
        sys.exit(f"needs {absent}: pip install {absent}")


load = imported("robot", "jaxsense.interfaces").load


def explore(contents: dict[str, Any], programs: Programs, classes: list[int]) -> list[str]:
    """The robots look at PoIs of the given classes until their policies say NOP.

    Args:
      contents: describes the programs, see `contents.json`.
      programs: by name.
      classes: true class of each PoI.

    Returns:
      A line for each look, and one for each PoI at the end.
    """
    num_pois, modalities, robots = len(classes), contents["modalities"], contents["robots"]
    number, has_own_maps = len(robots), "merge" in programs
    angles = 2 * np.pi * np.arange(num_pois) / num_pois
    team = {
        # On a circle around the robots.
        "positions": 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32),
        "present": np.ones(num_pois, bool),
        "poses": np.zeros((number, 3), np.float32),
        "modality": np.int32([modalities.index(name) for name in robots]),
        "works": np.ones(number, bool),
        "target": np.full(number, num_pois, np.int32),
    }
    maps = [empty(contents, num_pois) for _ in range(number if has_own_maps else 1)]
    lines = []
    while team["works"].any() and len(lines) < 20 * num_pois:
        for robot in np.flatnonzero(team["works"]).tolist():
            name, m = robots[robot], team["modality"][robot]
            known = maps[robot if has_own_maps else 0]
            of_map = {key: known[key] for key in ("mean", "std", "looked_from")}
            poi = int(programs["decide"](**of_map, **team, robot=robot)["action"])
            if poi in (num_pois, -1):
                team["works"][robot] = False
                continue
            # It arrives at once, and looks at the PoI from 0.9 m.
            place = team["poses"][robot, :2] = 0.55 * team["positions"][poi]
            labels = contents["labels"][name]
            label = contents["label_of_class"][name][classes[poi]]
            apart = np.linalg.norm(place - known["looked_from"][poi, m], axis=1)
            look = {
                "features": np.eye(len(labels))[label],
                "weight": programs[f"weigh_{name}"](apart=apart)["weight"],
            }
            if has_own_maps:
                known["sums"][robot, poi] += programs[f"tell_{name}"](**look)["evidence"]
                known.update(programs["merge"](sums=known["sums"]))
            else:
                write(programs[f"write_{name}"], known, poi, m, look)
            remember(contents, known, robot, poi, m, place)
            # Every second message is lost: the next one makes up for it.
            if has_own_maps and len(lines) % 2 == 0:
                tell(contents, programs, maps, robot)
            told = ", ".join(plausible(contents, programs, known)[poi])
            lines.append(f"{name} looks at PoI {poi}: {labels[label]}; it may be: {told}")
    if has_own_maps:  # back together, the robots tell each other everything
        for robot in range(number):
            tell(contents, programs, maps, robot)
    for poi, told in enumerate(plausible(contents, programs, maps[0])):
        name = contents["classes"][classes[poi]]
        lines.append(f"PoI {poi} is a {name}; the map says: {', '.join(told)}")
    return lines


def empty(contents: dict[str, Any], num_pois: int) -> dict[str, np.ndarray]:
    """A map before the first look.

    `sums` holds what each robot has said of its own looks, `number` how many looks that are, and
    `looked_from` their places, for each robot as many as it remembers.
    """
    number, modalities = len(contents["robots"]), contents["modalities"]
    remembered = number * contents["remembered_looks"]
    return {
        "mean": np.tile(np.float32(contents["unseen"]["mean"]), (num_pois, 1)),
        "std": np.tile(np.float32(contents["unseen"]["std"]), (num_pois, 1)),
        "seen": np.zeros((num_pois, len(modalities)), bool),
        "looked_from": np.full((num_pois, len(modalities), remembered, 2), np.inf, np.float32),
        "sums": np.zeros((number, num_pois, len(contents["classes"])), np.float32),
        "number": np.zeros(number, int),
    }


def write(
    program: Callable[..., dict[str, np.ndarray]],
    known: dict[str, np.ndarray],
    poi: int,
    m: int,
    look: dict[str, np.ndarray],
) -> None:
    """Updates the map that all robots share by a look."""
    belief = program(**{key: known[key][poi] for key in ("mean", "std", "seen")}, **look)
    known["mean"][poi], known["std"][poi] = belief["new_mean"], belief["new_std"]
    known["seen"][poi, m] = True


def remember(
    contents: dict[str, Any],
    known: dict[str, np.ndarray],
    robot: int,
    poi: int,
    m: int,
    place: np.ndarray,
) -> None:
    """Keeps from where a robot has looked, in place of its oldest look if there is no room."""
    remembered = contents["remembered_looks"]
    slot = robot * remembered + known["number"][robot] % remembered
    known["looked_from"][:, :, slot] = np.inf
    known["looked_from"][poi, m, slot] = place
    known["number"][robot] += 1


def tell(
    contents: dict[str, Any], programs: Programs, maps: list[dict[str, np.ndarray]], robot: int
) -> None:
    """A robot tells the others all that it has seen itself: sums, places and number of its looks.

    A receiver keeps the message of most looks: nothing counts twice.
    """
    own, remembered = maps[robot], contents["remembered_looks"]
    places = slice(robot * remembered, (robot + 1) * remembered)
    for known in maps:
        if own["number"][robot] > known["number"][robot]:
            known["number"][robot] = own["number"][robot]
            known["sums"][robot] = own["sums"][robot]
            known["looked_from"][:, :, places] = own["looked_from"][:, :, places]
            known.update(programs["merge"](sums=known["sums"]))


def plausible(
    contents: dict[str, Any], programs: Programs, known: dict[str, np.ndarray]
) -> list[list[str]]:
    """Names of the classes that the map leaves open, for each PoI."""
    found = programs["classify"](mean=known["mean"], std=known["std"])["plausible"]
    return [[contents["classes"][c] for c in np.flatnonzero(row)] for row in found]


def main() -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="from `jaxsense export`")
    arguments = parser.parse_args()
    try:
        contents, programs = load(arguments.file)
    except ValueError as error:
        sys.exit(str(error))
    for name, program in contents["programs"].items():
        print(f"{name}({', '.join(program['inputs'])}): {program['about']}")
    num_classes = len(contents["classes"])
    classes = [n % num_classes for n in range(contents["num_pois"])]
    print("\n".join(["", *explore(contents, programs, classes)]))


if __name__ == "__main__":
    main()
