"""Runs the file of `python -m jaxsense.export` with NumPy alone, or with onnxruntime.

    python examples/run_exported.py runs/.../exported.zip
    python examples/run_exported.py runs/.../exported.zip --onnx

lets a run's robots explore the points of interest (PoIs) of one map: each asks its policy where to
look, and updates the map with what its sensor detects there. Real robots run `detect` on their
scans; here the features are made up. The functions are in `robot_numpy.py` and `robot_onnx.py`,
which are in the file; copy one of them to a robot.
"""

import argparse
import importlib
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Programs = dict[str, Callable[..., dict[str, np.ndarray]]]


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
    number, remembered = len(robots), contents["remembered_looks"]
    angles = 2 * np.pi * np.arange(num_pois) / num_pois
    seen = np.zeros((num_pois, len(modalities)), bool)
    known = {
        "mean": np.tile(np.float32(contents["unseen"]["mean"]), (num_pois, 1)),
        "std": np.tile(np.float32(contents["unseen"]["std"]), (num_pois, 1)),
        "looked_from": np.full((num_pois, len(modalities), remembered, 2), np.inf, np.float32),
        # On a circle around the robots.
        "positions": 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32),
        "present": np.ones(num_pois, bool),
        "poses": np.zeros((number, 3), np.float32),
        "modality": np.int32([modalities.index(name) for name in robots]),
        "works": np.ones(number, bool),
        "target": np.full(number, num_pois, np.int32),
    }
    mean, std, looked_from = known["mean"], known["std"], known["looked_from"]
    looks = np.zeros((num_pois, len(modalities)), int)
    lines = []
    while known["works"].any() and len(lines) < 20 * num_pois:
        for robot in np.flatnonzero(known["works"]):
            name, m = robots[robot], known["modality"][robot]
            poi = int(programs["decide"](**known, robot=robot)["action"])
            if poi in (num_pois, -1):
                known["works"][robot] = False
                continue
            # It arrives at once, and looks at the PoI from 0.9 m.
            place = known["poses"][robot, :2] = 0.55 * known["positions"][poi]
            label = contents["label_of_class"][name][classes[poi]]
            labels = contents["labels"][name]
            apart = np.linalg.norm(place - looked_from[poi, m], axis=1)
            belief = programs[f"write_{name}"](
                mean=mean[poi],
                std=std[poi],
                seen=seen[poi],
                features=np.eye(len(labels))[label],
                weight=programs[f"weigh_{name}"](apart=apart)["weight"],
            )
            mean[poi], std[poi] = belief["new_mean"], belief["new_std"]
            looked_from[poi, m, looks[poi, m] % remembered] = place
            looks[poi, m] += 1
            seen[poi, m] = True
            told = ", ".join(plausible(contents, programs, known)[poi])
            lines.append(f"{name} looks at PoI {poi}: {labels[label]}; it may be: {told}")
    for poi, told in enumerate(plausible(contents, programs, known)):
        name = contents["classes"][classes[poi]]
        lines.append(f"PoI {poi} is a {name}; the map says: {', '.join(told)}")
    return lines


def plausible(
    contents: dict[str, Any], programs: Programs, known: dict[str, np.ndarray]
) -> list[list[str]]:
    """Names of the classes that the map leaves open, for each PoI."""
    found = programs["classify"](mean=known["mean"], std=known["std"])["plausible"]
    return [[contents["classes"][c] for c in np.flatnonzero(row)] for row in found]


def main() -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="from `python -m jaxsense.export`")
    parser.add_argument("--onnx", action="store_true", help="with onnxruntime instead of NumPy")
    arguments = parser.parse_args()
    path, name = arguments.file, "robot_onnx" if arguments.onnx else "robot_numpy"
    # Python imports from an archive as from a folder.
    sys.path.insert(0, str(path))
    try:
        contents, programs = importlib.import_module(name).load(path)
    except (OSError, zipfile.BadZipFile, json.JSONDecodeError, KeyError, ImportError) as error:
        sys.exit(f"{path}: must be a file of `python -m jaxsense.export` ({error})")
    for name, program in contents["programs"].items():
        print(f"{name}({', '.join(program['inputs'])}): {program['about']}")
    num_classes = len(contents["classes"])
    classes = [n % num_classes for n in range(contents["num_pois"])]
    print("\n".join(["", *explore(contents, programs, classes)]))


if __name__ == "__main__":
    main()
