"""All that host and controller must agree on: frames, messages, coded-stream and model-image layouts, transports."""
