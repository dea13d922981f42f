"""The whole training as pure functions: `learn`, and the stages that it executes."""

from jaxsense.training.stages import learn as learn
from jaxsense.training.stages import models as models
