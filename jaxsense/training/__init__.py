"""The whole training as pure functions: `learn`, and the stages that it executes."""

from jaxsense.training.stage import Progress as Progress
from jaxsense.training.stage import Stage as Stage
from jaxsense.training.stages import Learned as Learned
from jaxsense.training.stages import learn as learn
from jaxsense.training.stages import models as models
