"""A robot of the node for ROS 2 with programs that remember what they were asked."""

import math

import numpy as np

POSITIONS = np.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0]])
OWN = np.radians(np.arange(-40, 41, 10.0))  # nine beams, from right to left
CONTENTS = {
    "modalities": ["camera", "lidar"],
    "robots": ["camera", "lidar"],
    "classes": ["a", "b"],
    "labels": {"camera": ["red", "green"], "lidar": ["cylinder", "cube"]},
    "unseen": {"mean": [0.0], "std": [4.5]},
    "sensors": {"lidar": {"angles": OWN.tolist(), "window": math.radians(30.0)}},
    "viewpoint": {"min_distance": 0.3, "max_distance": 1.2, "max_bearing": 0.35},
    "mission": {"attempts": 3},
    "remembered_looks": 2,
    "programs": {"decide": {"inputs": {"positions": {"shape": [3, 2]}}}},
}


class Stub:
    """Programs that remember what they were asked; chooses PoIs in order, and detects."""

    def __init__(self):
        self.is_known, self.detects, self.asked, self.choices = True, True, [], [0, 1, 2, 3]

    def programs(self):
        writes = {f"write_{name}": self.write for name in CONTENTS["robots"]}
        weighs = {f"weigh_{name}": self.weigh for name in CONTENTS["robots"]}
        own = {"decide": self.decide, "detect_lidar": self.detect, "classify": self.classify}
        return {**own, **writes, **weighs}

    def classify(self, mean, std):
        return {"probabilities": np.stack([mean[:, 0], 1 - mean[:, 0]], axis=1)}

    def decide(self, present, **_):
        return {"action": next(n for n in self.choices if n == 3 or present[n])}

    def detect(self, **given):
        self.asked.append(given)
        detects = self.detects and self.is_known
        return {"is_known": self.is_known, "detects": detects, "features": np.array([0.75, 0.25])}

    def weigh(self, apart):
        return {"weight": 0.0 if (apart < 0.5).any() else 1.0}

    def write(self, mean, std, seen, features, weight):
        return {"new_mean": mean + weight * features[0], "new_std": std / 2}


def arrive(robot, pose=(0.0, 0.0, 0.0)):
    """Lets a robot choose at a pose, and gives the pose where it then goes."""
    robot.choose(0.0, np.array(pose))
    return robot.goal


def see(ros2, robot, pose, angles=OWN, readings=None, age=0.0):
    """The look of a robot that arrives at a pose, and stands still in the second scan."""
    readings = np.full(len(angles), 1.0) if readings is None else np.asarray(readings)
    scan = ros2.Scan(9.0 - age, np.asarray(pose, float), angles, readings)
    before = [scan._replace(stamp=scan.stamp - ago) for ago in (0.2, 0.1)]
    robot.see(9.0, before[0]._replace(pose=scan.pose + 1))
    first, second = [robot.see(9.0, each) for each in (before[1], scan)]
    assert first is None
    return second
