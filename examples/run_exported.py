"""Runs the file of `python -m jaxsense.export` with nothing but jax, NumPy and flatbuffers.

    python examples/run_exported.py runs/.../exported.zip

lets a run's robots explore the points of interest (PoIs) of one map: each asks its own policy where
to look, and updates the map with what its sensor detects there. Real robots run `detect` on their
scans; here the features are made up.
"""

import argparse
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

Programs = dict[str, Callable[..., dict[str, jax.Array]]]


def load(path: Path | str) -> tuple[dict[str, Any], Programs]:
    """Reads an exported file.

    Args:
      path: the file.

    Returns:
      Its `contents.json`, and its programs by name. They take and return arrays with a leading
      batch axis of any size; `contents["programs"][name]` lists names, shapes and dtypes of both.
    """
    with zipfile.ZipFile(path) as files:
        contents = json.loads(files.read("contents.json"))
        programs = {
            name: jax.jit(export.deserialize(bytearray(files.read(f"{name}.bin"))).call)
            for name in contents["programs"]
        }
    return contents, programs


def explore(contents: dict[str, Any], programs: Programs, classes: list[int]) -> list[str]:
    """The robots look at PoIs of the given classes until their policies say NOP.

    Args:
      contents: from `load`.
      programs: from `load`.
      classes: true class of each PoI.

    Returns:
      A line for each look, and one for each PoI at the end.
    """
    num_pois, modalities, robots = len(classes), contents["modalities"], contents["robots"]
    mean = np.tile(np.float32(contents["unseen"]["mean"]), (num_pois, 1))
    std = np.tile(np.float32(contents["unseen"]["std"]), (num_pois, 1))
    seen = np.zeros((num_pois, len(modalities)), bool)
    angles = 2 * np.pi * np.arange(num_pois, dtype=np.float32) / num_pois
    known = {
        "mean": mean,
        "std": std,
        # What policies of a team also read: positions in metres, on a circle around the robots.
        "positions": 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1),
        "present": np.ones(num_pois, bool),
        "poses": np.zeros((len(robots), 3), np.float32),
        "modality": np.int32([modalities.index(name) for name in robots]),
        "works": np.ones(len(robots), bool),
        "target": np.full(len(robots), num_pois, np.int32),
    }
    places: dict[tuple[str, int], list[np.ndarray]] = {}  # of looks by each sensor at each PoI
    lines = []
    while known["works"].any() and len(lines) < 20 * num_pois:
        for robot in np.flatnonzero(known["works"]):
            name = robots[robot]
            given = {**known, "robot": np.int32(robot)}
            inputs = contents["programs"][f"decide_{name}"]["inputs"]
            decided = programs[f"decide_{name}"](*(given[key][None] for key in inputs))
            action = int(decided["action"][0])
            if action == num_pois:
                known["works"][robot] = False
                continue
            label = contents["label_of_class"][name][classes[action]]
            labels = contents["labels"][name]
            features = np.eye(len(labels), dtype=np.float32)[label]
            poi = slice(action, action + 1)
            # It arrives at once, and looks at the PoI from 0.9 m.
            place = known["poses"][robot, :2] = 0.55 * known["positions"][action]
            earlier = places.setdefault((name, action), [np.float32([np.inf, np.inf])])
            apart = np.linalg.norm(place - np.stack(earlier[-4:]), axis=1)
            weight = programs[f"weigh_{name}"](apart[None])["weight"]
            earlier.append(place)
            look = mean[poi], std[poi], seen[poi], features[None], weight
            belief = programs[f"write_{name}"](*look)
            mean[poi], std[poi] = belief["mean"], belief["std"]
            seen[action, modalities.index(name)] = True
            told = ", ".join(np.array(contents["classes"])[plausible(programs, mean, std)[action]])
            lines.append(f"{name} looks at PoI {action}: {labels[label]}; it may be: {told}")
    for poi, told in enumerate(plausible(programs, mean, std)):
        names = ", ".join(np.array(contents["classes"])[told])
        lines.append(f"PoI {poi} is a {contents['classes'][classes[poi]]}; the map says: {names}")
    return lines


def plausible(programs: Programs, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """`[N, C]` bool, the classes that the map leaves open."""
    return np.asarray(programs["classify"](mean, std)["plausible"])


def main() -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="from `python -m jaxsense.export`")
    path = parser.parse_args().file
    try:
        contents, programs = load(path)
    except (OSError, zipfile.BadZipFile, KeyError) as error:
        sys.exit(f"{path}: must be a file of `python -m jaxsense.export` ({error})")
    for name, program in contents["programs"].items():
        print(f"{name}({', '.join(program['inputs'])}): {program['about']}")
    num_classes = len(contents["classes"])
    classes = [n % num_classes for n in range(contents["num_pois"])]
    print("\n".join(["", *explore(contents, programs, classes)]))


if __name__ == "__main__":
    main()
