"""Environments and their transforms. Importing this registers ``saferl/Intersection-*-v0``."""

from saferl.envs.cart import Cart, CartEnv
from saferl.envs.gym import GymEnvs, GymTask
from saferl.envs.intersection import register
from saferl.envs.seeding import SeededEnv

register()

__all__ = ["Cart", "CartEnv", "GymEnvs", "GymTask", "SeededEnv"]
