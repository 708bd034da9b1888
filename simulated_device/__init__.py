"""A controller in software: the same protocol and decoders, a DAC, and the response of an actuator."""
