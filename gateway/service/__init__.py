"""Configuration, wiring and supervision: how it is put together."""
