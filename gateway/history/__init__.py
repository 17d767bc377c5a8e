"""The daily log, kept for ever: harvest, store, export."""
