"""How scenes look: surfaces, lamps, textures, a fast renderer and the exposure of a picture."""
