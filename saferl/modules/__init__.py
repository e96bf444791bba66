"""Networks, critics, multipliers and the projection that algorithms are composed of."""

from saferl.modules.actors import GaussianHead, tanh_gaussian_actor
from saferl.modules.critics import StateValue, value_operator, zero_output
from saferl.modules.encoder import Encoder
from saferl.modules.ensemble import BoundCritics, CriticEnsemble
from saferl.modules.exploration import HeldActions
from saferl.modules.lagrange import DualAscent, LagrangeMultiplier, PIDMultiplier
from saferl.modules.mlp import MLP, MLPPolicyEncoder, MLPValue
from saferl.modules.mmam import MMAM, MMAMPolicyEncoder, MMAMValue
from saferl.modules.penalty import ExactPenalty, Switch
from saferl.modules.projection import ProjectionResult, project
from saferl.modules.risk import CVaR, Largest, MeanStd
from saferl.modules.scene import EGO_SCALE, VEHICLE_SCALE
from saferl.modules.sets import MaxPool, SetPolicyEncoder, SetValue

__all__ = [
    "EGO_SCALE",
    "MLP",
    "MMAM",
    "VEHICLE_SCALE",
    "BoundCritics",
    "CVaR",
    "CriticEnsemble",
    "DualAscent",
    "Encoder",
    "ExactPenalty",
    "GaussianHead",
    "HeldActions",
    "LagrangeMultiplier",
    "Largest",
    "MLPPolicyEncoder",
    "MLPValue",
    "MMAMPolicyEncoder",
    "MMAMValue",
    "MaxPool",
    "MeanStd",
    "PIDMultiplier",
    "ProjectionResult",
    "SetPolicyEncoder",
    "SetValue",
    "StateValue",
    "Switch",
    "project",
    "tanh_gaussian_actor",
    "value_operator",
    "zero_output",
]
