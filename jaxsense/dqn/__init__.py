"""The shared map as a Markov decision process, and deep Q-learning on it."""

from jaxsense.dqn import replay as replay
from jaxsense.dqn.agent import Agent as Agent
from jaxsense.dqn.agent import Environment as Environment
from jaxsense.dqn.mdp import LookSource as LookSource
from jaxsense.dqn.mdp import Mdp as Mdp
from jaxsense.dqn.mdp import Outcome as Outcome
from jaxsense.dqn.mdp import State as State
from jaxsense.dqn.mdp import step as step
from jaxsense.dqn.optimum import value_iteration as value_iteration
from jaxsense.dqn.policies import POLICIES as POLICIES
from jaxsense.dqn.policies import Known as Known
from jaxsense.dqn.rewards import Nats as Nats
from jaxsense.dqn.rewards import Paper as Paper
from jaxsense.dqn.rewards import Reward as Reward
from jaxsense.dqn.starts import reset as reset
from jaxsense.dqn.team import Travel as Travel
from jaxsense.dqn.training import train as train
