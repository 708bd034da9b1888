/* Verifies signatures of model images by Monocypher: a source for `python -m vibrocast.firmware.build --verifier`. */
#include "monocypher-ed25519.h"
#include "vibrocast/port.h"

int vc_port_verify_signature(void *context, const uint8_t *public_key, const uint8_t *signature, const uint8_t *message)
{
    (void)context;
    return crypto_ed25519_check(signature, public_key, message, VC_SIGNED_MESSAGE_BYTES) == 0;
}
