"""Measure and plot force over depth for one insertion into soft tissue.

    python benchmarks/force_profile.py
    python benchmarks/force_profile.py --presets phantom --speed 1 --out /tmp

The needle is guided as in a materials testing machine: it moves along the circle of its own arc
through both marks of the stitch, at `--speed`, and is so heavy (`INERT`) that nothing deflects it.
The force is the resistance to this motion: the torque of the tissue's forces about the circle's
axis, divided by its radius [N]. Depth is how far the tip is past the entry mark along the circle
[mm].

Frick, Marucci, Cartmill, Martin and Walsh (Journal of Biomechanics 34:1335, 2001) drove suture
needles through sheepskin in such a machine: the force rises as the skin tents, drops at the
puncture, rises with the length in the tissue, peaks again where the tip leaves, drops, and stays
constant while the shaft slides through.

Writes `force_over_depth.svg`, `.png` and `.json` into `--out`, by default `docs/`.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.envs.simulation import SUBSTEPS, Simulation
from surgicai_vision.envs.tissue import INSIDE, OUTSIDE, THROUGH, Tissue
from surgicai_vision.evaluation.provenance import provenance
from surgicai_vision.scene.rotations import matrix_to_quaternion

NAME = "force_over_depth"
BEFORE = 0.003
"""Distance of the tip before the entry mark at the beginning [m]."""
LEFT = 0.001
"""Length of the arc that is still outside the entry at the end [m]."""
INERT = 3e4
"""Factor on the needle's mass: MuJoCo's soft constraints then give the force of their springs to
1 %. A factor of a thousand is too small, a million too large for its solver."""
COLOURS = {"phantom": "#1f4e79", "skin": "#b0563a", "liver": "#7a4f8a"}
STAGES = {INSIDE: "in", THROUGH: "out"}


def insert(preset: str, speed: float) -> dict[str, Any]:
    """Drive the needle through tissue of a preset, at `speed` [m/s].

    Returns:
        Depth [mm] and force [N] at every control step, and the depths at which the tip enters and
        leaves.
    """
    env = envs.make(TaskConfig("insert", SceneConfig(tissue="soft", tissue_forces=preset)))
    env.reset(seed=names.VALIDATION_SEED)
    simulation = env.simulation
    tissue = simulation.tissue
    assert tissue is not None
    stitch = env.stitch
    _on_rails(simulation)
    radius = simulation.radius
    way = -BEFORE
    end = simulation.tip_angle * radius - LEFT
    depths = []
    forces = []
    events: dict[str, float] = {}
    stage = OUTSIDE
    while way < end:
        resisted = []
        for _ in range(SUBSTEPS):
            way += speed * env.model.opt.timestep
            _put(simulation, stitch.on_arc(simulation.tip_angle - way / radius), speed, radius)
            mujoco.mj_step(env.model, env.data)
            resisted.append(_resistance(simulation))
        _update(simulation, tissue)
        depths.append(1e3 * way)
        forces.append(float(np.mean(resisted)))
        if tissue.stage != stage:
            stage = tissue.stage
            events.setdefault(STAGES.get(stage, "base"), 1e3 * way)
    return {"depth_mm": depths, "force_n": forces, "events_mm": events, "tears": tissue.tears}


def _on_rails(simulation: Simulation) -> None:
    """Disable the arms' contacts and gravity, and make the needle too heavy to be deflected."""
    model = simulation.model
    model.opt.gravity[:] = 0.0
    for arm in names.ARMS:
        for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == _root(model, arm)):
            model.geom_contype[geom] = 0
            model.geom_conaffinity[geom] = 0
    body = model.body("needle").id
    model.body_mass[body] *= INERT
    model.body_inertia[body] *= INERT


def _root(model: mujoco.MjModel, arm: str) -> int:
    return int(model.body_rootid[model.body(f"{arm}_base").id])


def _put(simulation: Simulation, pose: np.ndarray, speed: float, radius: float) -> None:
    """Put the needle at T_world_needle (4, 4), turning about its own normal."""
    data = simulation.data
    place = simulation.scene.needle_qpos
    dof = int(simulation.model.joint("needle").dofadr[0])
    data.qpos[place] = [*pose[:3, 3], *matrix_to_quaternion(pose[:3, :3])]
    data.qvel[dof : dof + 6] = [0.0, 0.0, 0.0, 0.0, 0.0, -speed / radius]


def _resistance(simulation: Simulation) -> float:
    """Return the force against the needle's motion along its circle [N]."""
    about_normal = int(simulation.model.joint("needle").dofadr[0]) + 5
    return float(simulation.data.qfrc_constraint[about_normal]) / simulation.radius


def _update(simulation: Simulation, tissue: Tissue) -> None:
    """Update the tissue for the needle's position, as after every control step."""
    mujoco.mj_forward(simulation.model, simulation.data)
    tissue.update()


def draw(curves: dict[str, dict[str, Any]], speed: float) -> plt.Figure:
    """Return the figure: force over depth, one line per preset; the first has its events named."""
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    for index, (preset, curve) in enumerate(curves.items()):
        axes.plot(
            curve["depth_mm"],
            curve["force_n"],
            color=COLOURS[preset],
            linewidth=2.0 if index == 0 else 1.2,
            label=preset,
        )
    _name_events(axes, next(iter(curves.values())))
    axes.set_xlabel("travel of the tip beyond the entry mark [mm]")
    axes.set_ylabel("force against the motion [N]")
    axes.set_title(f"One insertion into soft tissue, {1e3 * speed:g} mm/s", fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylim(bottom=min(0.0, *(1.1 * min(curve["force_n"]) for curve in curves.values())))
    axes.set_xlim(left=-1e3 * BEFORE / 2)
    axes.legend(title="forces", frameon=False)
    return figure


def _name_events(axes: plt.Axes, curve: dict[str, Any]) -> None:
    """Label the events along a curve."""
    depth = np.array(curve["depth_mm"])
    force = np.array(curve["force_n"])
    first = curve["events_mm"]["in"]
    second = curve["events_mm"]["out"]
    top = force.max()
    for where, text in ((first, "tip goes in"), (second, "tip comes out")):
        axes.annotate(text, (where + 0.3, force[np.abs(depth - where) < 0.5].max()), fontsize=8)
    start = first + 1.0
    level = float(np.interp(second - 1.0, depth, force))
    axes.annotate(
        "friction grows with\nthe embedded length", (start, level + 0.05 * top), fontsize=8
    )
    last = second + 0.6 * (depth[-1] - second)
    level = float(np.interp(last, depth, force))
    axes.annotate("shaft slides through", (last, level + 0.04 * top), ha="center", fontsize=8)


def peaks(curve: dict[str, Any]) -> dict[str, float]:
    """Return a curve's key values [N], rounded."""
    depth = np.array(curve["depth_mm"])
    force = np.array(curve["force_n"])
    first = curve["events_mm"]["in"]
    second = curve["events_mm"]["out"]
    return {
        "first_peak_n": round(float(force[depth <= first + 0.2].max()), 3),
        "after_puncture_n": round(float(force[(depth > first) & (depth < first + 1.5)].min()), 3),
        "second_peak_n": round(float(force[np.abs(depth - second) < 0.6].max()), 3),
        "plateau_n": round(float(np.median(force[depth > second + 1.0])), 3),
    }


def main() -> None:
    """Drive, draw and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", choices=tuple(COLOURS), default=tuple(COLOURS))
    parser.add_argument("--speed", type=float, default=5.0, help="speed of the needle [mm/s]")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    chosen = parser.parse_args()
    if not (math.isfinite(chosen.speed) and 0.0 < chosen.speed <= 20.0):
        parser.error(f"--speed is {chosen.speed} mm/s; allowed: above 0, up to 20.")
    curves = {preset: insert(preset, chosen.speed / 1e3) for preset in chosen.presets}
    figure = draw(curves, chosen.speed / 1e3)
    plt.rcParams["svg.hashsalt"] = NAME  # the same file from the same curves
    figure.savefig(chosen.out / f"{NAME}.svg", metadata={"Date": None})
    figure.savefig(chosen.out / f"{NAME}.png", dpi=150)
    row = {
        "benchmark": "force_profile",
        "speed_mm_s": chosen.speed,
        "peaks": {preset: peaks(curve) for preset, curve in curves.items()},
        "made_with": provenance(render=False),
    }
    table = {
        preset: {
            **curve,
            "depth_mm": [round(value, 3) for value in curve["depth_mm"]],
            "force_n": [round(value, 4) for value in curve["force_n"]],
        }
        for preset, curve in curves.items()
    }
    (chosen.out / f"{NAME}.json").write_text(json.dumps({**row, "curves": table}, indent=1) + "\n")
    print(json.dumps(row))


if __name__ == "__main__":
    main()
