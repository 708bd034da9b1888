/* SHA-256 (FIPS 180-4), the identity of a model image. */
#ifndef VIBROCAST_SHA256_H
#define VIBROCAST_SHA256_H

#include <stddef.h>
#include <stdint.h>

#define VC_SHA256_BYTES 32

/* cffi: begin */
/* Writes the 32 bytes of the SHA-256 of `data`. Takes about 400 bytes of stack. */
void vc_sha256(const uint8_t *data, size_t length, uint8_t *digest);
/* cffi: end */

#endif
