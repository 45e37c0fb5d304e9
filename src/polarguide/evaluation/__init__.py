"""Metrics, records and figures: what a trained scene is worth, in numbers and to the eye."""
