"""Observations from the cars' own states."""

from __future__ import annotations

import math

import pytest
import torch

from saferl.envs.intersection.from_state import FromState
from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.observation import FORMS


@pytest.mark.parametrize("column", range(6))
@pytest.mark.parametrize("form", FORMS)
def test_a_car_that_is_known_in_part_does_not_seem_absent(form: str, column: int):
    ego, route = torch.tensor([[2.0, 55.0, 8.0, 0.0, -math.pi / 2, 0.0]] * 2), torch.tensor([1, 1])
    cars = torch.tensor([[[-2.0, 10.0, 9.0, 0.0, math.pi / 2, 0.0]]] * 2)
    cars[0, 0, column] = torch.nan
    seen = FromState(11, form)(ego, cars, route)
    assert seen["ego"][0].isnan().all() and seen["ego"][1].isfinite().all()
    nobody = FromState(11, form)(ego, cars * torch.nan, route)
    assert nobody["ego"].isfinite().all() and (nobody["vehicles"][..., 0] == 0).all()


@pytest.mark.parametrize("form", FORMS)
def test_a_route_that_does_not_exist_is_no_other(form: str):
    route = torch.arange(-1, len(ROUTES) + 1)
    ego = torch.tensor([[2.0, 55.0, 8.0, 0.0, -math.pi / 2, 0.0]]).expand(len(route), -1)
    seen = FromState(11, form)(ego, torch.full((len(route), 1, 6), torch.nan), route)
    assert seen["ego"].isnan().all(-1).tolist() == [True, *[False] * len(ROUTES), True]
