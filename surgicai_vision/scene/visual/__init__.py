"""Visual: what only meets the eye: materials, shapes, textures, the skin, the instruments."""
