"""Drive highway-env's own intersection by an exported policy, with onnxruntime and neither saferl nor torch.

python -m saferl.export pretrained=arsac out=policy format=onnx observation=state
python examples/drive_onnx.py policy/policy.onnx 20
"""

import sys

import gymnasium
import highway_env  # noqa: F401
import numpy as np
import onnxruntime

STRAIGHT_ON = np.array([1])  # the file's metadata lists the routes
ACTION = {"type": "ContinuousAction", "acceleration_range": (-5, 5), "steering_range": (-0.6, 0.6)}
CONFIG = {"action": {**ACTION, "dynamical": True}, "destination": "o2", "duration": 25}
CONFIG |= {"policy_frequency": 10, "simulation_frequency": 30}


def state(car) -> list[float]:
    """Of a car: x, y, v_x, v_y, phi, omega (m, m/s, rad, rad/s); the others' yaw rate by their bicycle model."""
    slip = np.arctan(np.tan(car.action["steering"]) / 2)
    omega = getattr(car, "yaw_rate", 2 * car.speed * np.sin(slip) / car.LENGTH)
    return [*car.position, car.speed, getattr(car, "lateral_speed", 0.0), car.heading, omega]


session = onnxruntime.InferenceSession(sys.argv[1])
env, ends = gymnasium.make("intersection-v1", config=CONFIG), []
for seed in range(int(sys.argv[2])):
    env.reset(seed=seed)
    terminated = truncated = False
    while not (terminated or truncated):
        ego, cars = env.unwrapped.vehicle, env.unwrapped.road.vehicles
        others = np.reshape([state(car) for car in cars if car is not ego], (1, -1, 6))
        seen = {"ego": np.float32([state(ego)]), "vehicles": others.astype(np.float32)}
        (action,) = session.run(["action"], {**seen, "route": STRAIGHT_ON})
        *_, terminated, truncated, info = env.step(action[0])
    ends.append("crashed" if info["crashed"] else "arrived" if terminated else "waiting")
print({end: ends.count(end) for end in sorted(set(ends))})
