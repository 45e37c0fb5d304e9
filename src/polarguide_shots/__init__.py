"""One exposure set without poses: its maps, their uncertainty, and which pixels say nothing.

``exposures`` lists the exposure sets behind paths, ``read`` reads one into ``ShotMaps``, ``write`` writes the maps of
many. Importing ``options`` does not load torch.
"""
