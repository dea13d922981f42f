"""Public functions name an argument that is of a wrong type, whichever it is."""

import inspect

import pytest

import jaxsense
from jaxsense import dqn, mission, recorded, sim, tasks, vae

# Of arrays, and called while a scan or a step is traced: nothing is checked on the host.
KERNELS = {"cast", "choose", "cross_section", "place"}


def required(function):
    parameters = inspect.signature(function).parameters.values()
    return [p for p in parameters if p.default is p.empty and p.kind not in (2, 4)]


FUNCTIONS = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in (jaxsense, dqn, mission, recorded, sim, tasks, vae)
    for name in {*dir(module)} - KERNELS
    if inspect.isroutine(getattr(module, name)) and required(getattr(module, name))
}


def call(name, arguments):
    """Calls a function with some arguments by position, as far as they may be."""
    kinds = {p.name: p.kind for p in required(FUNCTIONS[name])}
    named = {n: x for n, x in arguments.items() if kinds[n] is inspect.Parameter.KEYWORD_ONLY}
    FUNCTIONS[name](*(x for n, x in arguments.items() if n not in named), **named)


@pytest.mark.parametrize("value", [None, "x", 0.5j], ids=repr)
@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_value_of_a_wrong_type_is_named_in_one_line(name, value):
    parameters = required(FUNCTIONS[name])
    with pytest.raises(ValueError, match=r"^[^\n]+$") as refused:
        call(name, {p.name: value for p in parameters})
    message = str(refused.value)
    assert any(message.startswith(p.name) for p in parameters) or repr(value)[1:-1] in message


@pytest.mark.parametrize(
    "name", [name for name in sorted(FUNCTIONS) if required(FUNCTIONS[name])[0].name == "key"]
)
def test_a_seed_is_no_key(name):
    """Before anything else is looked at."""
    others = {p.name: None for p in required(FUNCTIONS[name])}
    with pytest.raises(ValueError, match="key = 7: must be one key"):
        call(name, {**others, "key": 7})
