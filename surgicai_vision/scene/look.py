"""Look: materials, textures, lights and everything in the scene that only meets the eye."""

import mujoco


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add the materials that other modules name: tissue, needle, thread, steel, jaw."""
    colours = {
        "tissue": [0.85, 0.55, 0.5, 1],
        "needle": [0.95, 0.95, 1.0, 1],
        "thread": [0.1, 0.1, 0.25, 1],
        "steel": [0.6, 0.62, 0.65, 1],
        "jaw": [0.75, 0.76, 0.8, 1],
    }
    for name, rgba in colours.items():
        spec.add_material(name=name, rgba=rgba)


def add_surroundings(spec: mujoco.MjSpec) -> None:
    """Add lights and background."""
    spec.worldbody.add_light(pos=[0.0, 0.1, 0.4], dir=[0, -0.2, -1], castshadow=False)


def dress(spec: mujoco.MjSpec) -> None:
    """Add visual-only geoms to finished bodies."""
