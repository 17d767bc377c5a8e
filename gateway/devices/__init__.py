"""What a controller is: map schema, codecs, read plan, daily-log decoding, maps/*.toml."""
