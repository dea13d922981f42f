"""What changes a program and what does not: numbers of the settings are none of its constants."""

import re

import jax
import pytest

from jaxsense.config import PRESETS
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs


@pytest.mark.slow  # traces everything twice
def test_no_number_is_a_constant_of_a_program():
    config = PRESETS["smoke"]
    # Without maps of their own, robots send no messages.
    must_be_zero = "communication.loss", "communication.delay"

    def changed(path, x):
        if isinstance(x, bool):
            return not x
        if jax.tree_util.keystr(path).endswith(must_be_zero):
            return x
        return x + 1 if isinstance(x, int) else 0.99 * (x or 0.01)

    other = jax.tree_util.tree_map_with_path(changed, config)
    pairs = zip(jax.tree.leaves(config), jax.tree.leaves(other), strict=True)
    assert sum(here == there for here, there in pairs) == len(must_be_zero)
    constants = [
        {name: set(re.findall(r"dense<.*?>", text)) for name, text in lowered(each).items()}
        for each in (config, other)
    ]
    assert len(constants[0]) > 15
    assert constants[0] == constants[1]


def lowered(config):
    """The programs of a run as text, by their names."""
    found = {}

    def compile_one(self, function, *args, **options):
        program = jax.jit(function).trace(*args)
        found[f"{self._stage}-{self._name}"] = program.lower().as_text()
        return program.out_info

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Program, "compile", compile_one)
        with Compiler(Monitor()) as compiler:
            made = Programs(config, compiler)
            for stage in made.stages:
                made.of(stage)
            made.player.result()
    return found
