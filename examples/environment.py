"""Make an environment, watch the expert solve it, and return to an earlier state.

python examples/environment.py --task grasp --seed 0
"""

import argparse

import gymnasium
import numpy as np
from PIL import Image

import surgicai_vision  # noqa: F401  registers the gymnasium ids
from surgicai_vision.demos.expert import Expert

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="grasp", help="grasp, place, insert, handoff or pullout")
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()

# What a policy may know: images, and the active arm's measured tip and jaw, but not the goal.
env = gymnasium.make(
    f"surgicai_vision/{arguments.task.capitalize()}-v0",
    obs_type="pixels_agent_pos",
    cameras=("front", "back"),
    image_size=224,
)
observation, info = env.reset(seed=arguments.seed)  # the same seed gives the same start
for key, value in observation.items():
    print(f"{key}: {value.shape} {value.dtype}")
print(f"distance to the goal: {1e3 * info['d_trans']:.1f} mm, {np.degrees(info['d_angle']):.0f}°")

# The expert is scripted and reads the simulator's whole state, so it can label any state.
expert = Expert(env.unwrapped)
actions = []
terminated = truncated = False
halfway = env.unwrapped.get_state()  # one vector with the complete state
while not (terminated or truncated):
    action = expert.action()  # (7,): motion of the active arm's tip and of its jaw, in [-1, 1]
    observation, reward, terminated, truncated, info = env.step(action)
    actions.append(action)
    if len(actions) == 20:
        halfway = env.unwrapped.get_state()
print(f"{len(actions)} steps, success: {info['is_success']}")

# Any stored state can be restored, and the same actions then give the same result, bit for bit.
last = env.unwrapped.get_state()
env.unwrapped.set_state_vector(halfway)
for action in actions[20:]:
    env.unwrapped.step(action)
print(
    "replayed from step 20, the same final state: "
    f"{np.array_equal(env.unwrapped.get_state(), last)}"
)

Image.fromarray(observation["front"]).save("environment.png")
print("the last image: environment.png")
env.close()
