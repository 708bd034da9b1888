/* SHA-512 (FIPS 180-4), which Ed25519 needs. */
#ifndef VIBROCAST_SHA512_H
#define VIBROCAST_SHA512_H

#include <stddef.h>
#include <stdint.h>

#define VC_SHA512_BYTES 64

/* cffi: begin */
/* A message on its way into the hash, a piece at a time. */
typedef struct {
    uint64_t hash[8];
    uint64_t length; /* bytes so far */
    uint8_t block[128];
} vc_sha512;

void vc_sha512_begin(vc_sha512 *sha512);
void vc_sha512_add(vc_sha512 *sha512, const uint8_t *data, size_t length);
/* Writes the 64 bytes of the SHA-512 of all pieces. */
void vc_sha512_end(vc_sha512 *sha512, uint8_t *digest);
/* cffi: end */

#endif
