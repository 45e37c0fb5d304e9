"""Run folders: what a training writes, and a trained run opened again."""
