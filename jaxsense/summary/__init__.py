"""The typed blocks of `summary.json`: makes, compares, averages and reads them."""

from jaxsense.summary.blocks import BLOCKS as BLOCKS
from jaxsense.summary.blocks import Agent as Agent
from jaxsense.summary.blocks import Case as Case
from jaxsense.summary.blocks import Evaluation as Evaluation
from jaxsense.summary.blocks import Learned as Learned
from jaxsense.summary.blocks import Missions as Missions
from jaxsense.summary.blocks import Origin as Origin
from jaxsense.summary.blocks import Results as Results
from jaxsense.summary.blocks import Summary as Summary
from jaxsense.summary.blocks import cases as cases
from jaxsense.summary.make import agent as agent
from jaxsense.summary.make import beliefs as beliefs
from jaxsense.summary.make import jmvae as jmvae
from jaxsense.summary.make import missions as missions
from jaxsense.summary.read import read as read
from jaxsense.summary.read import read_evaluations as read_evaluations
