/* Signatures by Ed25519 (RFC 8032), with the curve of Monocypher and SHA-512. */
#ifndef VIBROCAST_ED25519_H
#define VIBROCAST_ED25519_H

#include <stddef.h>
#include <stdint.h>

#define VC_KEY_BYTES 32
#define VC_SIGNATURE_BYTES 64

/* cffi: begin */
/* Writes the 32 bytes of the public key of a private one (RFC 8032, section 5.1.5). */
void vc_ed25519_public_key(const uint8_t *private_key, uint8_t *public_key);

/* Writes the 64 bytes of a message's signature (section 5.1.6). */
void vc_ed25519_sign(const uint8_t *private_key, const uint8_t *message, size_t length, uint8_t *signature);

/* Returns whether a signature is that of the message by the owner of the public key (section 5.1.7). Its time depends
 * on its arguments, which are no secrets. */
int vc_ed25519_check(const uint8_t *signature, const uint8_t *public_key, const uint8_t *message, size_t length);
/* cffi: end */

#endif
