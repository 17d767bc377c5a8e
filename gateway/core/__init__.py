"""Decisions, sans-IO, with time as an argument: who may, when, how often."""
