/* Runs a target over a corpus from stdin, and over changed copies of its inputs: `replay COPIES`.
 *
 * Corpus: inputs, each a length of four bytes (little-endian) and that number of bytes. The changes are the same at
 * every run.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "targets.h"

#define MAX_CHANGES 4u

static uint32_t random_state = 1;

/* Below `limit`; xorshift32 of Marsaglia, "Xorshift RNGs", Journal of Statistical Software 8(14), 2003. */
static size_t random_below(size_t limit)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 17;
    random_state ^= random_state << 5;
    return random_state % limit;
}

/* Runs a copy of an input of exactly this length, so that a sanitiser sees any read beyond it. */
static void run(const uint8_t *input, size_t length)
{
    uint8_t *copy = malloc(length);
    if (length > 0)
        memcpy(copy, input, length);
    (void)LLVMFuzzerTestOneInput(copy, length);
    free(copy);
}

/* Sets, flips, moves or cuts something of `input`; returns its new length. */
static size_t change(uint8_t *input, size_t length)
{
    size_t at = random_below(length), other = random_below(length), run_length;
    switch (random_below(5)) {
    case 0:
        input[at] = (uint8_t)random_below(256);
        break;
    case 1:
        input[at] ^= (uint8_t)(1u << random_below(8));
        break;
    case 2:
        input[at] = random_below(2) ? 0xFF : 0;
        break;
    case 3:
        run_length = 1 + random_below(length - (at > other ? at : other));
        memmove(input + at, input + other, run_length);
        break;
    default:
        return random_below(8) == 0 ? 1 + at : length;
    }
    return length;
}

static void run_changed(const uint8_t *input, size_t length)
{
    uint8_t *changed = malloc(length);
    size_t changes = 1 + random_below(MAX_CHANGES);
    memcpy(changed, input, length);
    while (changes-- > 0)
        length = change(changed, length);
    run(changed, length);
    free(changed);
}

int main(int argument_count, char **arguments)
{
    uint8_t head[4], *input;
    size_t length, inputs = 0;
    long copies = argument_count == 2 ? strtol(arguments[1], NULL, 10) : 0, copy;
    (void)LLVMFuzzerInitialize(&argument_count, &arguments);
    while (fread(head, 1, sizeof head, stdin) == sizeof head) {
        length = head[0] | (size_t)head[1] << 8 | (size_t)head[2] << 16 | (size_t)head[3] << 24;
        input = malloc(length);
        if (input == NULL || fread(input, 1, length, stdin) != length) {
            fprintf(stderr, "the corpus is cut\n");
            return 2;
        }
        run(input, length);
        for (copy = 0; copy < copies && length > 0; copy++)
            run_changed(input, length);
        free(input);
        inputs++;
    }
    printf("%zu inputs\n", inputs);
    return 0;
}
