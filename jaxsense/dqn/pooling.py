"""A Q-network that treats all points of interest alike, for any number of them.

One small network reads each PoI, with what lies around it and a pool over all of them (Zaheer et
al. 2017, Deep Sets); NOP's value comes from the pool. PoIs that are not present count nowhere.
"""

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsense.networks import Dense

_REACHES = (0.5, 1.5)  # m, over which PoIs count as neighbours
_MESSAGES = 8
_NOTHING = -1e6  # value of a PoI that is not present


class PoolingNetwork(nn.Module):
    """The Q-network of a team.

    Attributes:
      hidden: sizes of the hidden layers, the same for each PoI.
      features: numbers known of each PoI; the last three are its presence and its place.
    """

    hidden: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[F * N]` to `[N + 1]` values, NOP's last; or `[F * N, B]` to `[N + 1, B]`."""
        batch = x.shape[1:]
        chex.assert_is_divisible(x.shape[0], self.features)
        x = x.reshape(self.features, x.shape[0] // self.features, *batch)
        present, place = x[-3][None], x[-2:]
        known = x[:-2]
        flat = known.reshape(known.shape[0], -1)
        for i, size in enumerate(self.hidden):
            flat = nn.relu(Dense(size, nn.initializers.he_normal(), name=f"PoI_{i}")(flat))
        each = flat.reshape(-1, *known.shape[1:]) * present
        number = jnp.maximum(jnp.sum(present, axis=1), 1.0)
        pool = jnp.concatenate([jnp.sum(each, axis=1) / number, jnp.max(each, axis=1)])
        around = self._messages(flat, present, place)
        own = jnp.concatenate([known, each, around])
        size = self.hidden[-1]
        last = nn.initializers.lecun_normal()
        context = Dense(size, nn.initializers.he_normal(), name="Context")(pool)
        of_poi = Dense(size, nn.initializers.he_normal(), name="Own")(own.reshape(own.shape[0], -1))
        of_poi = nn.relu(of_poi.reshape(size, *known.shape[1:]) + context[:, None])
        value = Dense(1, last, name="Value")(of_poi.reshape(size, -1))
        value = value.reshape(*known.shape[1:])
        nop = Dense(1, last, name="NOP")(nn.relu(context))
        return jnp.concatenate([jnp.where(present[0] > 0, value, _NOTHING), nop])

    def _messages(self, flat: jax.Array, present: jax.Array, place: jax.Array) -> jax.Array:
        """What lies around each PoI: messages of all PoIs, the near ones weighing most."""
        sent = Dense(_MESSAGES, nn.initializers.lecun_normal(), name="Message")(flat)
        sent = nn.relu(sent).reshape(_MESSAGES, *present.shape[1:]) * present
        apart = jnp.sqrt(jnp.sum((place[:, :, None] - place[:, None]) ** 2, axis=0) + 1e-6)
        gathered = [
            jnp.sum(jnp.exp(-apart / reach)[None] * sent[:, None], axis=2) for reach in _REACHES
        ]
        return jnp.concatenate(gathered)
