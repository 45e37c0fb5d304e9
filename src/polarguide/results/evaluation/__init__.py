"""How good a trained scene is: metrics, their one table, and the record of a run."""
