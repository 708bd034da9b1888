"""The host's side of a session: devices, players, uploads and reports.

Come in by `playback`: it plays a coded stream on a device, compares what came back, and reports. `live_playback` plays
a source that goes on, `hand_playback` plays a profile under a hand, and `uploader` brings model images to a device.
They stand on `devices`, which opens a session, a controller and its actuator, by its address, and on `controller`, the
requests to one.
"""
