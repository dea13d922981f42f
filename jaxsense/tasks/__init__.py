"""Frozen tasks, their scores, and trained models that ship with the package."""

from jaxsense.tasks.registry import PRETRAINED as PRETRAINED
from jaxsense.tasks.registry import load_pretrained as load_pretrained
from jaxsense.tasks.registry import make as make
from jaxsense.tasks.registry import origin as origin
from jaxsense.tasks.registry import registered as registered
from jaxsense.tasks.score import Estimate as Estimate
from jaxsense.tasks.score import Recurrent as Recurrent
from jaxsense.tasks.score import Score as Score
from jaxsense.tasks.score import mean_return as mean_return
from jaxsense.tasks.score import on_host as on_host
from jaxsense.tasks.score import score as score
from jaxsense.tasks.task import Environment as Environment
from jaxsense.tasks.task import Task as Task
from jaxsense.tasks.task import TimeStep as TimeStep
