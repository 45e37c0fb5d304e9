"""Polarization maps of single shots without poses, measurement of shots, and calibration of sensors.

``exposures`` finds the exposure sets in paths, ``read`` reads a set into ``ShotMaps``, and ``write`` writes the maps of
many sets. The import of ``options`` does not load torch.
"""
