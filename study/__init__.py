"""Listening studies: prepare stimuli from a TOML file, lead participants through trials, analyse the answers."""
