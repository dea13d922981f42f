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
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SILENCE = 5.0  # s, after which a robot that tells nothing counts as failed

Arrays = dict[str, np.ndarray]
Programs = dict[str, Callable[..., Arrays]]


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


def require(is_right: Any, message: str) -> None:
    """Raises `ValueError` unless something is right."""
    if not is_right:
        raise ValueError(message)


def numbers(name: str, value: Any, shape: tuple[int, ...], most: float | None = None) -> np.ndarray:
    """Finite numbers of a shape; from 0 to `most`, if there is one."""
    found = np.asarray(value, np.float32)
    is_right = found.shape == shape and np.isfinite(found).all()
    require(is_right, f"{name} = {value!r}: must be finite numbers of shape {shape}")
    is_within = most is None or ((found >= 0) & (found <= most)).all()
    require(is_within, f"{name} = {value!r}: must be from 0 to {most}")
    return found


class Robot:
    """A robot of a team: what it knows, and which PoI it looks at next.

    Attributes:
      team: what it knows of all robots and PoIs, as `decide` reads it.
      known: its map, see `empty`.
    """

    def __init__(self, contents: dict[str, Any], programs: Programs, robot: int, positions: Any):
        """A robot before its first look.

        Args:
          contents: of the archive.
          programs: of the archive.
          robot: its index in the `robots` of the archive.
          positions: `[N, 2]` of the PoIs in a frame that all robots share, in metres.
        """
        robots, pois = contents["robots"], len(positions)
        positions = numbers("positions", np.asarray(positions).tolist(), (pois, 2))
        is_apart = len(np.unique(positions, axis=0)) == pois
        require(is_apart, f"positions = {positions.tolist()}: must differ from each other")
        names = dict(enumerate(robots))
        require(robot in names, f"robot = {robot}: must be one of {names}")
        expected = contents["programs"]["decide"]["inputs"]["positions"]["shape"][0]
        anyway = "export pretrained:team or many for a policy for any number"
        is_known = expected in ("pois", pois)
        require(is_known, f"{pois} PoIs: the policy of this archive is for {expected}; {anyway}")
        self.contents, self.programs, self.robot, self.name = (
            contents,
            programs,
            robot,
            names[robot],
        )
        self.team = {
            "positions": positions,
            "present": np.ones(pois, bool),
            "poses": np.zeros((len(robots), 3), np.float32),
            "modality": np.int32([contents["modalities"].index(name) for name in robots]),
            "works": np.arange(len(robots)) == robot,
            "target": np.full(len(robots), pois, np.int32),
        }
        self.known = empty(contents, pois)
        self.heard_at = np.full(len(robots), -np.inf)

    @property
    def is_done(self) -> bool:
        """Whether it looks at nothing more."""
        return not self.team["works"][self.robot]

    def decide(self, now: float) -> int | None:
        """The PoI to look at next; None for NOP, which ends its part."""
        is_own = np.arange(len(self.heard_at)) == self.robot
        self.team["works"] &= (now - self.heard_at <= SILENCE) | is_own
        known = {name: self.known[name] for name in ("mean", "std", "looked_from")}
        pois = len(self.team["positions"])
        chosen = int(self.programs["decide"](**known, **self.team, robot=self.robot)["action"])
        ends = chosen in (pois, -1)
        self.team["target"][self.robot] = pois if ends else chosen
        self.team["works"][self.robot] = not ends
        return None if ends else chosen

    def weight(self, poi: int, place: np.ndarray) -> float:
        """Share of a look from a place that is new after the earlier ones by this sensor."""
        earlier = self.known["looked_from"][poi, self.team["modality"][self.robot]]
        apart = np.linalg.norm(earlier - place, axis=1)
        return float(self.programs[f"weigh_{self.name}"](apart=apart)["weight"])

    def look(self, poi: int, place: np.ndarray, features: np.ndarray) -> dict[str, Any]:
        """Updates the map by a look of its own, which it returns for `report`."""
        found = {"features": np.asarray(features).tolist(), "weight": self.weight(poi, place)}
        look = {"poi": poi, **found, "place": np.asarray(place).tolist()}
        self.write(self.robot, look)
        return look

    def write(self, robot: int, look: dict[str, Any]) -> None:
        """Updates the map by a look of any robot; if each has a map of its own, by one of this."""
        known, poi, m = self.known, look["poi"], self.team["modality"][robot]
        name = self.contents["robots"][robot]
        given = {key: np.asarray(look[key], np.float32) for key in ("features", "weight")}
        if "merge" in self.programs:
            known["sums"][robot, poi] += self.programs[f"tell_{name}"](**given)["evidence"]
            known.update(self.programs["merge"](sums=known["sums"]))
        else:
            before = {key: known[key][poi] for key in ("mean", "std", "seen")}
            after = self.programs[f"write_{name}"](**before, **given)
            known["mean"][poi], known["std"][poi] = after["new_mean"], after["new_std"]
            known["seen"][poi, m] = True
        remember(self.contents, known, robot, poi, m, np.array(look["place"]))

    def report(self, look: dict[str, Any] | None = None) -> str:
        """What the robot tells the others: its state, and a look that it has taken, once."""
        pose, target = self.team["poses"][self.robot].tolist(), int(self.team["target"][self.robot])
        state = {"robot": self.robot, "pose": pose, "target": target, "works": not self.is_done}
        return json.dumps({**state, "look": look})

    def hear(self, now: float, report: str) -> None:
        """Takes in what a robot tells; its own report is ignored.

        Raises:
          ValueError: if it is no report of a robot in the team; it then changes nothing.
        """
        pois, robots = len(self.team["positions"]), self.contents["robots"]
        try:
            told = json.loads(report)
            robot, works, look = told["robot"], told["works"], told["look"]
            of_look = [] if look is None else [("poi", look["poi"], pois)]
            integers = ("robot", robot, len(robots)), ("target", told["target"], pois + 1), *of_look
            for name, value, number in integers:
                is_index = type(value) is int and 0 <= value < number
                require(is_index, f"{name} = {value!r}: must be an integer from 0 to {number - 1}")
            require(isinstance(works, bool), f"works = {works!r}: must be true or false")
            pose = numbers("pose", told["pose"], (3,))
            if robot == self.robot:
                return
            if look is not None:
                numbers("place", look["place"], (2,))
                numbers("weight", look["weight"], (), 1)
                labels = self.contents["labels"][robots[robot]]
                numbers("features", look["features"], (len(labels),), 1)
                self.write(robot, look)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"no report of a robot in the team: {error!r}") from error
        self.heard_at[robot] = now
        for name, value in (("poses", pose), ("target", told["target"]), ("works", works)):
            self.team[name][robot] = value

    def classes(self, of: str) -> np.ndarray:
        """What the map says about the classes: `probabilities` or `plausible`, `[N, C]`."""
        return self.programs["classify"](mean=self.known["mean"], std=self.known["std"])[of]


def empty(contents: dict[str, Any], num_pois: int) -> Arrays:
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


def remember(
    contents: dict[str, Any], known: Arrays, robot: int, poi: int, m: int, place: np.ndarray
) -> None:
    """Keeps from where a robot has looked, in place of its oldest look if there is no room."""
    remembered = contents["remembered_looks"]
    slot = robot * remembered + known["number"][robot] % remembered
    known["looked_from"][:, :, slot] = np.inf
    known["looked_from"][poi, m, slot] = place
    known["number"][robot] += 1


def tell(contents: dict[str, Any], programs: Programs, maps: list[Arrays], robot: int) -> None:
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


def explore(contents: dict[str, Any], programs: Programs, classes: list[int]) -> list[str]:
    """The robots look at PoIs of the given classes until their policies say NOP.

    Returns a line for each look, and one for each PoI at the end.
    """
    # PoIs on a circle around the robots.
    angles = 2 * np.pi * np.arange(len(classes)) / len(classes)
    positions = 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    team = [Robot(contents, programs, i, positions) for i in range(len(contents["robots"]))]
    has_own_maps, lines = "merge" in programs, []
    for robot in team:
        robot.team["works"][:] = True
        robot.heard_at[:] = 0.0
    while any(not robot.is_done for robot in team) and len(lines) < 20 * len(classes):
        for i, robot in enumerate(team):
            if robot.is_done:
                continue
            look = None
            if (poi := robot.decide(now=0.0)) is not None:
                # It arrives at once, and looks at the PoI from 0.9 m.
                place = robot.team["poses"][i, :2] = 0.55 * robot.team["positions"][poi]
                labels = contents["labels"][robot.name]
                label = contents["label_of_class"][robot.name][classes[poi]]
                look = robot.look(poi, place, np.eye(len(labels))[label])
                told = ", ".join(names(contents, robot.classes("plausible")[poi]))
                lines.append(f"{robot.name} looks at PoI {poi}: {labels[label]}; may be: {told}")
            for other in team:
                other.hear(0.0, robot.report(None if has_own_maps else look))
            # Every second message is lost: the next one makes up for it.
            if has_own_maps and len(lines) % 2 == 0:
                tell(contents, programs, [each.known for each in team], i)
    for i in range(len(team) if has_own_maps else 0):  # back together, they tell everything
        tell(contents, programs, [each.known for each in team], i)
    for poi, plausible in enumerate(team[0].classes("plausible")):
        name, told = contents["classes"][classes[poi]], ", ".join(names(contents, plausible))
        lines.append(f"PoI {poi} is a {name}; the map says: {told}")
    return lines


def names(contents: dict[str, Any], plausible: np.ndarray) -> list[str]:
    """Names of the classes that are left open."""
    return [contents["classes"][c] for c in np.flatnonzero(plausible)]


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
    classes = [n % len(contents["classes"]) for n in range(contents["num_pois"])]
    print("\n".join(["", *explore(contents, programs, classes)]))


if __name__ == "__main__":
    main()
