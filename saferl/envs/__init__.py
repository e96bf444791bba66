"""Environments and their transforms. Importing this registers ``saferl/Intersection-*-v0``."""

from saferl.envs.intersection import register

register()
