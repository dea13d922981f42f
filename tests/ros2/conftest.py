import importlib
from pathlib import Path

import pytest
from ros2_robot import CONTENTS, POSITIONS, Stub

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def ros2():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield importlib.import_module("ros2_node")


@pytest.fixture
def stub():
    return Stub()


@pytest.fixture
def robot(ros2, stub):
    return ros2.Robot(CONTENTS, stub.programs(), 1, POSITIONS)
