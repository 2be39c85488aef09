"""Measure speed.

Physics, images, resets and workers, against the bare libraries at equal settings.

    python benchmarks/speed.py
    python benchmarks/speed.py --only step --repeats 40

* step: `env.step` (obs_type state) along an expert's whole procedure, against a loop of
  `mj_step(…, nstep)` over the same model, states and commands. Both must end in the same positions.
  Without thread and with 10 segments.
* tissue: `env.step` along an expert's whole procedure in tissue "soft" against "channels", each
  with its own procedure; ratio of their steps/s. Without thread and with 10 segments.
* frames: `FrameRenderer.render` against `mujoco.Renderer` with the same shadows, multisampling and
  triangles, on the same states. Both must give the same pixels. One core: llvmpipe draws in the
  calling thread.
* crop: `env.image` of a crop against a camera that aims at the jaws, as in version 0.1, with the
  same size, position and field of view.
* looks: frames of episodes that each have their own look (`randomisation: appearance`), against the
  same episodes again, whose looks are already drawn, and against episodes of the plain look. An
  episode is a reset and 200 observations of two views.
* skin: images of every state of an expert's procedure in soft tissue, with a skin that follows the
  state and with an intact skin; two views per state, as for policies. Also in channels.
* reset: per task [ms].
* workers: two worker processes against one, in steps of all envs per second: gymnasium's
  asynchronous vector env (`async_…`, one env per worker) and ours (`shares_…`, `--share` envs per
  worker), with state and with images.
* help: `--help` as a whole process [s].

The two sides take turns; figures are medians over the turns, and ratios are medians of the turns'
ratios. `--clock cpu` uses the process's CPU time instead of wall-clock time, for a shared machine;
workers and help are always timed by the wall clock.
"""

import argparse
import copy
import functools
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ["LP_NUM_THREADS"] = "0"

import gymnasium
import mujoco
import numpy as np
from common import emit, median

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.cameras import CAMERAS
from surgicai_vision.core.config import RandomisationConfig, SceneConfig, TaskConfig
from surgicai_vision.core.tasks import SUBTASK_STEPS, env_id
from surgicai_vision.demos.expert import Expert
from surgicai_vision.envs.skin import Skin
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.cameras import crop_of
from surgicai_vision.scene.compose import build_spec
from surgicai_vision.scene.rendering import QUALITIES, FrameRenderer

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
SIZE = 224
CAMERA = "front"
CROP = "front_psm2"
POSES = 16


class Recording(NamedTuple):
    """An expert's episode.

    The env, its first state, the actions, and the resulting servo commands.
    """

    env: envs.SuturingEnv
    start: np.ndarray
    actions: np.ndarray
    commands: np.ndarray


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


class Clock:
    """The clock used for all timing; chosen on the command line."""

    now = staticmethod(CLOCKS["wall"])


def timed(function: Callable[[], Any]) -> float:
    """Return how long a call takes [s]."""
    start = Clock.now()
    function()
    return Clock.now() - start


def in_turns(
    one: Callable[[], None], other: Callable[[], None], repeats: int
) -> tuple[list[float], list[float]]:
    """Return the times [s] of two calls that take turns; which one goes first alternates.

    The first turn is discarded.
    """
    times: tuple[list[float], list[float]] = ([], [])
    for turn in range(repeats + 1):
        for index in (0, 1) if turn % 2 else (1, 0):
            times[index].append(timed((one, other)[index]))
    return times[0][1:], times[1][1:]


def ratio(slow: list[float], fast: list[float]) -> float:
    """Return the median of slow / fast over the turns."""
    return median([a / b for a, b in zip(slow, fast, strict=True)])


def record(scene: SceneConfig) -> Recording:
    """Let the expert throw one stitch."""
    config = TaskConfig("suture", scene)
    env = envs.make(config)
    env.reset(seed=names.VALIDATION_SEED)
    expert = Expert(env)
    start = env.get_state()
    actions = []
    commands = []
    for _ in range(config.max_steps):
        actions.append(expert.action())
        ended = env.step(actions[-1])[2]
        commands.append(env.data.ctrl.copy())
        if ended:
            break
    return Recording(env, start, np.array(actions), np.array(commands))


def measure_step(thread: int, repeats: int) -> dict[str, Any]:
    """Time the env's steps against the bare physics."""
    env, start, actions, commands = record(SceneConfig(thread=thread))
    model = env.model
    data = mujoco.MjData(env.model)
    nstep = env.frame_skip

    def through_env() -> None:
        for action in actions:
            env.step(action)

    def bare() -> None:
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep)

    def both() -> tuple[float, float]:
        env.set_state_vector(start)
        mujoco.mj_setState(model, data, start, STATE)
        return timed(through_env), timed(bare)

    both()
    if not np.array_equal(env.data.qpos, data.qpos):
        raise SystemExit(
            "env.step and the bare loop ended in different positions; the comparison is invalid."
        )
    times = np.array([both() for _ in range(repeats)])
    return {
        "control_steps": len(actions),
        "env_steps_per_s": round(len(actions) / median(times[:, 0].tolist(), 9)),
        "bare_steps_per_s": round(len(actions) / median(times[:, 1].tolist(), 9)),
        "of_bare": ratio(times[:, 1].tolist(), times[:, 0].tolist()),
    }


def measure_tissue(thread: int, repeats: int) -> dict[str, Any]:
    """Time the env's steps in soft tissue against those in channels."""
    kinds = ("soft", "channels")
    recordings = [record(SceneConfig(thread=thread, tissue=kind)) for kind in kinds]

    def play(recording: Recording) -> None:
        recording.env.set_state_vector(recording.start)
        for action in recording.actions:
            recording.env.step(action)

    for recording in recordings:
        play(recording)
        if not recording.env.measure()["is_success"]:
            raise SystemExit("The expert's procedure failed; the comparison is invalid.")
    soft, channels = (functools.partial(play, recording) for recording in recordings)
    times = in_turns(soft, channels, repeats)
    rates = [
        [len(recording.actions) / seconds for seconds in turns]
        for recording, turns in zip(recordings, times, strict=True)
    ]
    return {
        "control_steps": dict(zip(kinds, (len(r.actions) for r in recordings), strict=True)),
        **{
            f"{kind}_steps_per_s": round(median(rate))
            for kind, rate in zip(kinds, rates, strict=True)
        },
        "of_channels": ratio(*rates),
    }


def measure_frames(repeats: int, frames: int) -> dict[str, Any]:
    """Time our images against MuJoCo's own renderer."""
    env, start, actions, _ = record(SceneConfig())
    env.set_state_vector(start)
    states = []
    for index, action in enumerate(actions):
        env.step(action)
        if index % (len(actions) // POSES) == 0:
            states.append(copy.copy(env.data))
    model = copy.deepcopy(env.model)
    _set_quality(model)
    ours = FrameRenderer(env.model, SIZE, SIZE)
    bare = mujoco.Renderer(model, SIZE, SIZE)
    bare.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0

    def draw(state: mujoco.MjData) -> np.ndarray:
        bare.update_scene(state, CAMERA)
        return bare.render()

    same = all(np.array_equal(ours.render(state, CAMERA), draw(state)) for state in states)

    def through_ours() -> None:
        for index in range(frames):
            ours.render(states[index % len(states)], CAMERA)

    def through_bare() -> None:
        for index in range(frames):
            draw(states[index % len(states)])

    first, second = in_turns(through_ours, through_bare, repeats)
    default = mujoco.Renderer(env.model, SIZE, SIZE)
    slow = timed(
        lambda: [(default.update_scene(state, CAMERA), default.render()) for state in states]
    )
    for renderer in (default, bare, ours):
        renderer.close()
    return {
        "size": SIZE,
        "camera": CAMERA,
        "same_pixels": same,
        "frames_per_s": round(frames / median(first, 9)),
        "bare_frames_per_s": round(frames / median(second, 9)),
        "of_bare": ratio(second, first),
        "bare_frames_per_s_at_mujocos_default_quality": round(len(states) / slow, 1),
    }


def measure_crop(repeats: int, frames: int) -> dict[str, Any]:
    """Time a crop against a camera that aims at the jaws, on the same states."""
    env, start, actions, _ = record(SceneConfig())
    spec = build_spec(env.config.scene)
    crop = crop_of(CROP)
    stand = CAMERAS.load(crop.camera)
    target = spec.body(f"{crop.arm}_tip").add_body(name="target", pos=[0.0, 0.0, GRASP_DEPTH])
    spec.worldbody.add_camera(
        name="aimed",
        pos=list(stand.position),
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
        targetbody=target.name,
        fovy=math.degrees(2.0 * math.atan(crop.span / 2.0 / crop.distance)),
    )
    model = spec.compile()
    states = []
    aimed = []
    env.set_state_vector(start)
    for index, action in enumerate(actions):
        env.step(action)
        if index % (len(actions) // POSES) == 0:
            states.append(env.get_state())
            data = mujoco.MjData(model)
            data.qpos[:] = env.data.qpos
            mujoco.mj_forward(model, data)
            aimed.append(data)
    follower = FrameRenderer(model, SIZE, SIZE)
    env.image(CROP, (SIZE, SIZE))
    turns: tuple[list[float], list[float]] = ([], [])
    for state, data in zip(states, aimed, strict=True):
        env.set_state_vector(state)
        pair = in_turns(
            lambda: [env.image(CROP, (SIZE, SIZE)) for _ in range(frames // POSES)],
            lambda data=data: [follower.render(data, "aimed") for _ in range(frames // POSES)],
            repeats,
        )
        for kept, new in zip(turns, pair, strict=True):
            kept.extend(new)
    follower.close()
    env.close()
    return {
        "size": SIZE,
        "view": CROP,
        "frames_per_s": round(frames // POSES / median(turns[0], 9)),
        "aimed_frames_per_s": round(frames // POSES / median(turns[1], 9)),
        "of_aimed": ratio(turns[1], turns[0]),
    }


def _set_quality(model: mujoco.MjModel) -> None:
    """Give a model the settings of our quality "fast"."""
    quality = QUALITIES["fast"]
    visual = model.vis.quality
    visual.offsamples = quality.samples
    visual.numslices = quality.slices
    visual.numstacks = quality.stacks
    visual.numquads = quality.quads


def measure_looks(repeats: int) -> dict[str, Any]:
    """Time the images of episodes with new looks, with repeated looks, and with the plain look."""
    plain, looking = (
        envs.make(
            TaskConfig("place", randomisation=RandomisationConfig(appearance=appearance)),
            obs_type="pixels",
            cameras=("front", "back"),
            image_size=SIZE,
        )
        for appearance in ("", names.TRAIN)
    )

    def episode(env: envs.SuturingEnv, seed: int) -> float:
        def run() -> None:
            env.reset(seed=seed)
            for _ in range(SUBTASK_STEPS):
                env.observe()

        return timed(run)

    for env in (plain, looking):
        episode(env, 0)
    times = np.array(
        [
            (episode(looking, seed), episode(looking, seed), episode(plain, seed))
            for seed in range(1, repeats + 1)
        ]
    )
    frames = 2 * SUBTASK_STEPS
    new, again, without = times.T.tolist()
    return {
        "new_looks_frames_per_s": round(frames / median(new, 9)),
        "same_looks_frames_per_s": round(frames / median(again, 9)),
        "plain_frames_per_s": round(frames / median(without, 9)),
        "new_of_same": ratio(again, new),
        "new_of_plain": ratio(without, new),
    }


def measure_skin(repeats: int) -> dict[str, Any]:
    """Time images of soft tissue whose skin follows the state against images of an intact skin."""
    rates: dict[str, list[float]] = {"following": [], "whole": [], "channels": []}
    filmed = {kind: _states(SceneConfig(tissue=kind)) for kind in ("soft", "channels")}
    env = filmed["soft"][0]
    tissue = env.simulation.tissue
    assert tissue is not None
    with (
        FrameRenderer(env.model, SIZE, SIZE, skin=Skin(env.simulation, tissue)) as following,
        FrameRenderer(filmed["channels"][0].model, SIZE, SIZE) as channels,
    ):
        for _ in range(repeats):
            rates["following"].append(_rate(*filmed["soft"], following))
            env.set_state_vector(filmed["soft"][1][0])
            following.render(env.data, CAMERA)  # the first state's skin is intact
            with FrameRenderer(env.model, SIZE, SIZE) as whole:
                rates["whole"].append(_rate(*filmed["soft"], whole))
            rates["channels"].append(_rate(*filmed["channels"], channels))
    return {
        **{f"{kind}_frames_per_s": round(median(values)) for kind, values in rates.items()},
        "following_of_whole": ratio(rates["following"], rates["whole"]),
        "following_of_channels": ratio(rates["following"], rates["channels"]),
    }


def _states(scene: SceneConfig) -> tuple[envs.SuturingEnv, list[np.ndarray]]:
    """Return an env and every state of an expert's procedure in it."""
    env, start, actions, _ = record(scene)
    env.set_state_vector(start)
    states = [start]
    for action in actions:
        env.step(action)
        states.append(env.get_state())
    return env, states


def _rate(env: envs.SuturingEnv, states: list[np.ndarray], renderer: FrameRenderer) -> float:
    """Return images per second, two per state; restoring the state is not timed."""
    seconds = 0.0
    for state in states:
        env.set_state_vector(state)
        seconds += timed(lambda: [renderer.render(env.data, CAMERA) for _ in range(2)])
    return 2 * len(states) / seconds


def measure_reset(repeats: int) -> dict[str, float]:
    """Return the median time of a reset per task [ms]."""
    row = {}
    for task in names.TASKS:
        env = envs.make(TaskConfig(task))
        env.reset(seed=0)
        times = [
            timed(lambda seed=seed, env=env: env.reset(seed=seed))
            for seed in range(1, 5 * repeats + 1)
        ]
        row[task] = median([seconds * 1e3 for seconds in times], 2)
    return row


def measure_workers(repeats: int, steps: int, obs_type: str, share: int) -> dict[str, Any]:
    """Time vector envs with one and with two workers.

    Args:
        repeats: turns.
        steps: vector steps in a turn.
        obs_type: what the envs show.
        share: envs per worker of our vector env; 0 for gymnasium's asynchronous vector env.
    """
    chosen = {
        "obs_type": obs_type,
        **({"cameras": (CAMERA,), "image_size": SIZE} if obs_type == "pixels" else {}),
    }
    vectors = [_vector(workers, share, chosen) for workers in (1, 2)]
    rng = np.random.default_rng(0)
    for vector in vectors:
        vector.reset(seed=0)

    def drive(vector: gymnasium.vector.VectorEnv) -> None:
        for _ in range(steps):
            vector.step(rng.uniform(-0.2, 0.2, (vector.num_envs, 7)).astype(np.float32))

    one, two = in_turns(lambda: drive(vectors[0]), lambda: drive(vectors[1]), repeats)
    taken = [steps * vector.num_envs for vector in vectors]
    for vector in vectors:
        vector.close()
    return {
        "one_steps_per_s": round(taken[0] / median(one, 9)),
        "two_steps_per_s": round(taken[1] / median(two, 9)),
        "two_of_one": ratio([2 * seconds for seconds in one], two),
    }


def _vector(workers: int, share: int, chosen: dict[str, Any]) -> gymnasium.vector.VectorEnv:
    """Return a vector env of the subtask insert that never truncates."""
    task = env_id("insert")
    chosen = {"max_episode_steps": 10**6, **chosen}
    if share:
        return gymnasium.make_vec(task, workers * share, workers=workers, **chosen)
    return gymnasium.make_vec(task, workers, "async", vector_kwargs={"context": "spawn"}, **chosen)


def measure_help(repeats: int) -> dict[str, float]:
    """Return the wall time of `--help` as a whole process [s], the median of `repeats`."""
    program = str(Path(sys.executable).with_name("surgicai-vision"))
    found = {}
    for arguments in (["--help"], ["train", "--help"]):
        call = functools.partial(subprocess.run, [program, *arguments], capture_output=True)
        found[" ".join(arguments)] = median([timed(call) for _ in range(repeats)])
    return found


def main() -> None:
    """Measure and print one JSON line."""
    parts = ("step", "tissue", "frames", "crop", "looks", "skin", "reset", "workers", "help")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=parts, nargs="+", default=parts)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--frames", type=int, default=100, help="frames or vector steps per turn")
    parser.add_argument("--share", type=int, default=16, help="envs per worker of the vector env")
    parser.add_argument("--clock", choices=tuple(CLOCKS), default="wall")
    chosen = parser.parse_args()
    Clock.now = staticmethod(CLOCKS[chosen.clock])
    row: dict[str, Any] = {"repeats": chosen.repeats, "clock": chosen.clock}
    if "step" in chosen.only:
        row["step"] = {
            f"thread_{thread}": measure_step(thread, chosen.repeats) for thread in (0, 10)
        }
    if "tissue" in chosen.only:
        row["tissue"] = {
            f"thread_{thread}": measure_tissue(thread, chosen.repeats) for thread in (0, 10)
        }
    if "frames" in chosen.only:
        row["frames"] = measure_frames(chosen.repeats, chosen.frames)
    if "crop" in chosen.only:
        row["crop"] = measure_crop(chosen.repeats, chosen.frames)
    if "looks" in chosen.only:
        row["looks"] = measure_looks(chosen.repeats)
    if "skin" in chosen.only:
        row["skin"] = measure_skin(chosen.repeats)
    if "reset" in chosen.only:
        row["reset_ms"] = measure_reset(chosen.repeats)
    if "help" in chosen.only:
        Clock.now = staticmethod(CLOCKS["wall"])
        row["help_s"] = measure_help(chosen.repeats)
    if "workers" in chosen.only:
        Clock.now = staticmethod(CLOCKS["wall"])
        row["workers"] = {
            f"{how}_{kind}": measure_workers(chosen.repeats, chosen.frames, kind, share)
            for how, share in (("async", 0), ("shares", chosen.share))
            for kind in ("state", "pixels")
        }
    row["load_average"] = [round(value, 2) for value in os.getloadavg()]
    emit("speed", row, render=bool({"frames", "crop", "looks", "skin"} & {*chosen.only}))


if __name__ == "__main__":
    main()
