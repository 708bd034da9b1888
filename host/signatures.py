"""Signatures of model images: made, and checked as a controller with a key checks them."""

from vibrocast.device_protocol.model_image import MAX_NUMBER, ModelError, ModelImage, signed_message, with_signature
from vibrocast.firmware import keys


def signed(image: bytes, private_key: bytes, number: int) -> bytes:
    """Return a packed model image with a signature, in place of any before.

    `number`: of the release, from 1 on; a controller takes none below the highest one confirmed. Raises
    ModelError for bytes that are no image, or another number, and MissingExtraError.
    """
    ModelImage.unpack(image)
    if not 1 <= number <= MAX_NUMBER:
        raise ModelError(f"the number {number} is not in 1 to {MAX_NUMBER}; count releases from 1 on")
    return with_signature(image, number, keys.sign(private_key, signed_message(image, number)))


def check(image: bytes, public_key: bytes) -> ModelImage:
    """Return the image that the owner of a public key has signed.

    Raises ModelError for any other, and MissingExtraError.
    """
    held = ModelImage.unpack(image)
    if not held.signature:
        raise ModelError(f"the model image {held.name} has no signature; sign it with `vibrocast keys sign`")
    if not keys.is_signed(held.signature, public_key, signed_message(image, held.number)):
        raise ModelError(
            f"the signature of the model image {held.name} is not by the key {public_key.hex()[:16]}, or the image has "
            "changed; sign it with that key"
        )
    return held
