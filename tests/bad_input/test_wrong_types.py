"""Public functions name an argument that is of a wrong type, whichever it is."""

import inspect

import pytest

import jaxsense
from jaxsense import dqn, mission, sim, tasks, vae

# Of arrays, and called while a scan or a step is traced: nothing is checked on the host.
KERNELS = {"cast", "choose", "cross_section", "place"}


def required(function):
    parameters = inspect.signature(function).parameters.values()
    return [p for p in parameters if p.default is p.empty and p.kind not in (2, 4)]


FUNCTIONS = {
    name: getattr(module, name)
    for module in (jaxsense, dqn, mission, sim, tasks, vae)
    for name in {*dir(module)} - KERNELS
    if inspect.isroutine(getattr(module, name)) and required(getattr(module, name))
}


@pytest.mark.parametrize("value", [None, "x", 0.5j], ids=repr)
@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_value_of_a_wrong_type_is_named_in_one_line(name, value):
    function = FUNCTIONS[name]
    parameters = required(function)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as refused:
        function(
            *(value for p in parameters if p.kind is not p.KEYWORD_ONLY),
            **{p.name: value for p in parameters if p.kind is p.KEYWORD_ONLY},
        )
    message = str(refused.value)
    assert any(message.startswith(p.name) for p in parameters) or repr(value)[1:-1] in message
