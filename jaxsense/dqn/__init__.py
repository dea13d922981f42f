"""The shared map as a Markov decision process, and deep Q-learning on it."""

from jaxsense.dqn import replay as replay
from jaxsense.dqn.map_agent import MapAgent as MapAgent
from jaxsense.dqn.map_mdp import Looks as Looks
from jaxsense.dqn.map_mdp import MapMdp as MapMdp
from jaxsense.dqn.map_mdp import MapState as MapState
from jaxsense.dqn.map_mdp import Outcome as Outcome
from jaxsense.dqn.map_mdp import reset as reset
from jaxsense.dqn.map_mdp import step as step
from jaxsense.dqn.optimum import value_iteration as value_iteration
from jaxsense.dqn.policies import POLICIES as POLICIES
from jaxsense.dqn.policies import Known as Known
from jaxsense.dqn.policies import Policy as Policy
from jaxsense.dqn.rewards import Nats as Nats
from jaxsense.dqn.rewards import Paper as Paper
from jaxsense.dqn.rewards import Reward as Reward
from jaxsense.dqn.team_agent import TeamAgent as TeamAgent
from jaxsense.dqn.team_mdp import TeamMdp as TeamMdp
from jaxsense.dqn.team_mdp import TeamState as TeamState
from jaxsense.dqn.team_mdp import Travel as Travel
from jaxsense.dqn.training import train as train
