"""Hyperparameter search: batches of trials, each batch one population."""
