/* Ed25519; names are those of RFC 8032, section 5.1. */
#include "vc_ed25519.h"

#include "../core/vc_common.h"
#include "../monocypher/vc_monocypher.h"
#include "../core/vc_sha512.h"

/* SHA-512(first || second || message) as a number modulo the order of the group. */
static void hash_to_scalar(uint8_t *scalar, const uint8_t *first, const uint8_t *second, const uint8_t *message,
                           size_t length)
{
    uint8_t digest[VC_SHA512_BYTES];
    vc_sha512 sha512;
    vc_sha512_begin(&sha512);
    vc_sha512_add(&sha512, first, VC_KEY_BYTES);
    if (second != NULL)
        vc_sha512_add(&sha512, second, VC_KEY_BYTES);
    vc_sha512_add(&sha512, message, length);
    vc_sha512_end(&sha512, digest);
    crypto_eddsa_reduce(scalar, digest);
}

/* The secret scalar s, and the prefix behind it. */
static void expand(const uint8_t *private_key, uint8_t *expanded)
{
    vc_sha512 sha512;
    vc_sha512_begin(&sha512);
    vc_sha512_add(&sha512, private_key, VC_KEY_BYTES);
    vc_sha512_end(&sha512, expanded);
    crypto_eddsa_trim_scalar(expanded, expanded);
}

void vc_ed25519_public_key(const uint8_t *private_key, uint8_t *public_key)
{
    uint8_t expanded[VC_SHA512_BYTES];
    expand(private_key, expanded);
    crypto_eddsa_scalarbase(public_key, expanded);
    crypto_wipe(expanded, sizeof expanded);
}

void vc_ed25519_sign(const uint8_t *private_key, const uint8_t *message, size_t length, uint8_t *signature)
{
    uint8_t expanded[VC_SHA512_BYTES], public_key[VC_KEY_BYTES], r[32], k[32];
    expand(private_key, expanded);
    crypto_eddsa_scalarbase(public_key, expanded);
    hash_to_scalar(r, expanded + 32, NULL, message, length);
    crypto_eddsa_scalarbase(signature, r); /* R */
    hash_to_scalar(k, signature, public_key, message, length);
    crypto_eddsa_mul_add(signature + 32, k, expanded, r); /* S */
    crypto_wipe(expanded, sizeof expanded);
    crypto_wipe(r, sizeof r);
}

int vc_ed25519_check(const uint8_t *signature, const uint8_t *public_key, const uint8_t *message, size_t length)
{
    uint8_t k[32];
    hash_to_scalar(k, signature, public_key, message, length);
    return crypto_eddsa_check_equation(signature, public_key, k) == 0;
}
