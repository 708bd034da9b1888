"""The conformance suite: what docs/protocol.md asks of a controller, tried through nothing but its port."""
