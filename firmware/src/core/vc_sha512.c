/* SHA-512; names and functions are those of FIPS 180-4, sections 4.1.3, 5 and 6.4. */
#include "vc_sha512.h"

#include "vc_common.h"

#define BLOCK_BYTES 128u
#define LENGTH_BYTES 16u
#define ROUNDS 80u

/* The first 64 bits of the fractions of the cube roots of the first 80 primes. */
static const uint64_t k[ROUNDS] = {
    0x428a2f98d728ae22, 0x7137449123ef65cd, 0xb5c0fbcfec4d3b2f, 0xe9b5dba58189dbbc, 0x3956c25bf348b538,
    0x59f111f1b605d019, 0x923f82a4af194f9b, 0xab1c5ed5da6d8118, 0xd807aa98a3030242, 0x12835b0145706fbe,
    0x243185be4ee4b28c, 0x550c7dc3d5ffb4e2, 0x72be5d74f27b896f, 0x80deb1fe3b1696b1, 0x9bdc06a725c71235,
    0xc19bf174cf692694, 0xe49b69c19ef14ad2, 0xefbe4786384f25e3, 0x0fc19dc68b8cd5b5, 0x240ca1cc77ac9c65,
    0x2de92c6f592b0275, 0x4a7484aa6ea6e483, 0x5cb0a9dcbd41fbd4, 0x76f988da831153b5, 0x983e5152ee66dfab,
    0xa831c66d2db43210, 0xb00327c898fb213f, 0xbf597fc7beef0ee4, 0xc6e00bf33da88fc2, 0xd5a79147930aa725,
    0x06ca6351e003826f, 0x142929670a0e6e70, 0x27b70a8546d22ffc, 0x2e1b21385c26c926, 0x4d2c6dfc5ac42aed,
    0x53380d139d95b3df, 0x650a73548baf63de, 0x766a0abb3c77b2a8, 0x81c2c92e47edaee6, 0x92722c851482353b,
    0xa2bfe8a14cf10364, 0xa81a664bbc423001, 0xc24b8b70d0f89791, 0xc76c51a30654be30, 0xd192e819d6ef5218,
    0xd69906245565a910, 0xf40e35855771202a, 0x106aa07032bbd1b8, 0x19a4c116b8d2d0c8, 0x1e376c085141ab53,
    0x2748774cdf8eeb99, 0x34b0bcb5e19b48a8, 0x391c0cb3c5c95a63, 0x4ed8aa4ae3418acb, 0x5b9cca4f7763e373,
    0x682e6ff3d6b2b8a3, 0x748f82ee5defb2fc, 0x78a5636f43172f60, 0x84c87814a1f0ab72, 0x8cc702081a6439ec,
    0x90befffa23631e28, 0xa4506cebde82bde9, 0xbef9a3f7b2c67915, 0xc67178f2e372532b, 0xca273eceea26619c,
    0xd186b8c721c0c207, 0xeada7dd6cde0eb1e, 0xf57d4f7fee6ed178, 0x06f067aa72176fba, 0x0a637dc5a2c898a6,
    0x113f9804bef90dae, 0x1b710b35131c471b, 0x28db77f523047d84, 0x32caab7b40c72493, 0x3c9ebe0a15c9bebc,
    0x431d67c49c100d4c, 0x4cc5d4becb3e42b6, 0x597f299cfc657e2a, 0x5fcb6fab3ad6faec, 0x6c44198c4a475817};

/* Those of the square roots of the first eight primes. */
static const uint64_t initial_hash[8] = {0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b,
                                         0xa54ff53a5f1d36f1, 0x510e527fade682d1, 0x9b05688c2b3e6c1f,
                                         0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};

static uint64_t rotated(uint64_t x, unsigned bits)
{
    return x >> bits | x << (64 - bits);
}

/* The message schedule, w, keeps its last 16 words: W_t is in w[t % 16]. */
static void add_block(uint64_t *hash, const uint8_t *block)
{
    uint64_t w[16], s[8], t1, t2;
    unsigned t, i;
    for (t = 0; t < 16; t++)
        for (w[t] = 0, i = 0; i < 8; i++)
            w[t] = w[t] << 8 | block[8 * t + i];
    memcpy(s, hash, sizeof s); /* a, b, ..., h */
    for (t = 0; t < ROUNDS; t++) {
        if (t >= 16) {
            const uint64_t w2 = w[(t - 2) % 16], w15 = w[(t - 15) % 16];
            w[t % 16] += (rotated(w2, 19) ^ rotated(w2, 61) ^ w2 >> 6) + w[(t - 7) % 16] +
                         (rotated(w15, 1) ^ rotated(w15, 8) ^ w15 >> 7);
        }
        t1 = s[7] + (rotated(s[4], 14) ^ rotated(s[4], 18) ^ rotated(s[4], 41)) + ((s[4] & s[5]) ^ (~s[4] & s[6])) +
             k[t] + w[t % 16];
        t2 = (rotated(s[0], 28) ^ rotated(s[0], 34) ^ rotated(s[0], 39)) +
             ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        for (i = 7; i > 0; i--)
            s[i] = s[i - 1];
        s[4] += t1;
        s[0] = t1 + t2;
    }
    for (i = 0; i < 8; i++)
        hash[i] += s[i];
}

void vc_sha512_begin(vc_sha512 *sha512)
{
    memcpy(sha512->hash, initial_hash, sizeof sha512->hash);
    sha512->length = 0;
}

void vc_sha512_add(vc_sha512 *sha512, const uint8_t *data, size_t length)
{
    for (; length > 0; length--) {
        sha512->block[sha512->length++ % BLOCK_BYTES] = *data++;
        if (sha512->length % BLOCK_BYTES == 0)
            add_block(sha512->hash, sha512->block);
    }
}

void vc_sha512_end(vc_sha512 *sha512, uint8_t *digest)
{
    static const uint8_t padding[BLOCK_BYTES] = {0x80};
    const uint64_t bits = sha512->length * 8;
    const size_t used = sha512->length % BLOCK_BYTES;
    uint8_t length[LENGTH_BYTES] = {0};
    unsigned i;
    for (i = 0; i < 8; i++)
        length[LENGTH_BYTES - 1 - i] = (uint8_t)(bits >> 8 * i);
    vc_sha512_add(sha512, padding, (2 * BLOCK_BYTES - LENGTH_BYTES - used - 1) % BLOCK_BYTES + 1);
    vc_sha512_add(sha512, length, LENGTH_BYTES);
    for (i = 0; i < VC_SHA512_BYTES; i++)
        digest[i] = (uint8_t)(sha512->hash[i / 8] >> (56 - 8 * (i % 8)));
}
