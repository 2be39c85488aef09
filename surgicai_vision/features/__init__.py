"""Features: frozen encoders, the cache of what they computed, and a linear probe of it."""
