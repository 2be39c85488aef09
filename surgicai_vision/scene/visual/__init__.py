"""Visual: what is only seen: materials, shapes, textures, the skin, the instruments."""
