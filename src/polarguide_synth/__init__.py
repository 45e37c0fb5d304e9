"""Polarized scenes with ground truth, rendered by physical light transport: the extra ``synth``.

A scene file (``schema``) becomes meshes (``shapes``), textures (``textures``) and Mitsuba scenes (``build``).
``transport`` traces polarized paths, ``film`` renders the pixels of a camera, ``geometry`` computes ground truth,
``sparse`` simulates the COLMAP model and ``sensor`` the raw mosaics of a polarization camera; ``render`` writes the
folder. Mitsuba is imported inside functions only, after ``variant`` has chosen one of its variants.
"""
