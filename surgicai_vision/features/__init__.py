"""Features: frozen encoders, the cache of their features, and a linear probe of them."""
