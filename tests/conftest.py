"""Settings of every test: hypothesis tries the same examples everywhere, whatever the speed; and fixtures."""

from hypothesis import HealthCheck, settings

from tests.sound_server import mortal_sound_server as mortal_sound_server
from tests.sound_server import pulseaudio as pulseaudio
from tests.sound_server import sound_server as sound_server
from tests.sound_server import sound_servers as sound_servers

settings.register_profile("all", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("all")
