"""A trained scene as one textured mesh for other programs: surface, texture coordinates, baked textures, file."""
