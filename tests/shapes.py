"""A checker of array shapes for jaxtyping's import hook, and a program that calls what it checks.

It checks annotations that name a shape, and leaves all other types to pyright.
"""

import dataclasses
import inspect
import json
from typing import get_args

import beartype
import jaxtyping

_CONFIG = beartype.BeartypeConf(is_pep484_tower=True)  # an int is a float
CHECKED = set[str]()
"""Names of the functions whose arrays are checked."""


def checked(function):
    """Checks the shapes of a function's arrays, one item of each tuple, at every call."""
    hints = {name: hint for name, hint in function.__annotations__.items() if _has_shape(hint)}
    # JAX rebuilds pytrees with batches and placeholders in their fields.
    if not hints or function.__name__ == "__init__":
        return function
    CHECKED.add(f"{function.__module__}.{function.__qualname__}")
    function.__annotations__ = hints
    return beartype.beartype(conf=_CONFIG)(function)


def _has_shape(hint) -> bool:
    is_shape = inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray)
    return is_shape or any(map(_has_shape, get_args(hint)))


def main() -> None:
    """Traces trainings and a mission, and prints what was checked and refused, as JSON."""
    import shapes

    # It stays: `jaxsense` imports its modules when they are first used.
    jaxtyping.install_import_hook("jaxsense", "shapes.checked")
    import jax
    import jax.numpy as jnp
    from training.tiny import KEY, TINY

    import jaxsense
    from jaxsense import mission
    from jaxsense.vae.gaussian import kl_divergence

    team = dataclasses.replace(
        TINY,
        jmvae=dataclasses.replace(TINY.jmvae, fusion="filter"),
        dqn=dataclasses.replace(TINY.dqn, task="team"),
    )
    for config in (TINY, team):
        jax.eval_shape(lambda key: jaxsense.learn(key, config), KEY)  # noqa: B023
    there, models = mission.make_mission(TINY), jaxsense.init(KEY, TINY)

    def play(key):
        return mission.rollout(key, there, models, mission.reset(key, there, models), 3)

    jax.eval_shape(play, KEY)

    look, seen, two = jnp.full(2, 0.5), jnp.zeros(2, bool), jnp.zeros(2)
    models.bayes.update(models.bayes.prior, look, 1)
    models.fusion.update(models.fusion.prior, seen, look, 1)
    wrong = {
        "kl_divergence": lambda: kl_divergence(two, two, jnp.zeros(3), two),
        "log_likelihoods": lambda: models.bayes.log_likelihoods(look[None], 0),
        "update": lambda: models.fusion.update(models.fusion.prior, two, look, 1),
    }
    refused = {}
    for name, call in wrong.items():
        try:
            call()
        except jaxtyping.TypeCheckError as error:
            refused[name] = str(error).splitlines()[0]
    print(json.dumps({"checked": sorted(shapes.CHECKED), "refused": refused}))


if __name__ == "__main__":
    main()
