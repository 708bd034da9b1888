"""A request that the controller refuses."""

from vibrocast.device_protocol.messages import ErrorCode


class Refusal(Exception):
    """Why a request is refused; becomes the Error message that answers it."""

    def __init__(self, code: ErrorCode, text: str) -> None:
        super().__init__(text)
        self.code = code
