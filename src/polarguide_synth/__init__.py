"""Render polarized scenes with ground truth by physical light transport (needs the extra ``synth``).

``schema`` validates a scene file. ``build`` converts it to meshes (``mesh``), textures (``textures``) and Mitsuba
scenes. ``transport`` traces polarized paths. ``sensor`` renders the pixels of a camera and simulates photographs.
``ground_truth`` computes normals, depth and materials, and ``colmap`` simulates the COLMAP model. ``render`` writes the
scene folder. Mitsuba is imported on first use, after ``settings.start_mitsuba`` has selected a variant.
"""
