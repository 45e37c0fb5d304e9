"""Polarized scenes with ground truth, rendered by physical light transport: the optional extra ``polarguide[synth]``.

A scene is data (``schema``), becomes triangles (``shapes``), pictures (``textures``) and Mitsuba's objects (``build``);
``transport`` follows polarized light, ``views`` renders a view and its ground truth, ``sparse`` makes the COLMAP model,
``sensor`` what a polarization camera would have recorded, and ``run`` writes the folder. Mitsuba is imported inside
functions only, once ``variant`` has chosen how it computes.
"""
