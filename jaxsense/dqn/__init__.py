"""The shared map as a Markov decision process, and deep Q-learning on it."""

from jaxsense.dqn.belief_mdp import MapMdp as MapMdp
from jaxsense.dqn.belief_mdp import MapState as MapState
from jaxsense.dqn.belief_mdp import Outcome as Outcome
from jaxsense.dqn.belief_mdp import information as information
from jaxsense.dqn.belief_mdp import observation as observation
from jaxsense.dqn.belief_mdp import reset as reset
from jaxsense.dqn.belief_mdp import step as step
from jaxsense.dqn.optimum import LookValues as LookValues
from jaxsense.dqn.optimum import interpolate as interpolate
from jaxsense.dqn.optimum import solve as solve
from jaxsense.dqn.policies import by_posterior as by_posterior
from jaxsense.dqn.policies import greedy as greedy
from jaxsense.dqn.policies import naive as naive
from jaxsense.dqn.policies import optimal as optimal
from jaxsense.dqn.policies import random as random
from jaxsense.dqn.training import DqnState as DqnState
from jaxsense.dqn.training import train as train
