"""Quality of a trained scene: definitions of metrics, the table that lists them, and the record of a run."""
