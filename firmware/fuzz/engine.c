/* Runs a target over a corpus from stdin, and over changed copies of its inputs: `engine SECONDS SEED FILE`.
 *
 * Corpus: inputs, each a length of four bytes (little-endian) and that number of bytes. SECONDS: how long to change
 * them; 0 = not at all. An input that reaches code, or a count of passes through it, that no other has reached joins
 * the corpus, where the compiler counts passes (-fsanitize-coverage=inline-8bit-counters, of Clang). The input of a
 * fault is written to FILE.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "engine.h"

#define MAX_CHANGES 8u
#define MAX_LENGTH 65536u

typedef struct {
    uint8_t *bytes;
    size_t length;
} input;

static input *corpus, running;
static size_t corpus_count;
static const char *fault_file;
static uint64_t random_state;

/* Counters of passes, one for each edge, and the classes of counts seen so far in each, a bit each. */
static uint8_t *counters, *seen;
static size_t counter_count;

/* The compiler's code calls this before main. */
void __sanitizer_cov_8bit_counters_init(uint8_t *begin, uint8_t *end);
void __sanitizer_cov_8bit_counters_init(uint8_t *begin, uint8_t *end)
{
    counters = begin;
    counter_count = (size_t)(end - begin);
}

/* Below `limit`; xorshift64* of Vigna, "An experimental exploration of Marsaglia's xorshift generators, scrambled", ACM
 * Transactions on Mathematical Software 42(4), 2016. */
static size_t random_below(size_t limit)
{
    random_state ^= random_state >> 12;
    random_state ^= random_state << 25;
    random_state ^= random_state >> 27;
    return (size_t)((random_state * 0x2545F4914F6CDD1Du >> 32) % limit);
}

/* Saves the input of a fault. */
static void save(int number)
{
    FILE *file = fopen(fault_file, "wb");
    if (file != NULL) {
        (void)fwrite(running.bytes, 1, running.length, file);
        (void)fclose(file);
    }
    (void)signal(number, SIG_DFL);
    (void)raise(number);
}

static uint8_t class_of(uint8_t count)
{
    static const uint8_t least[8] = {1, 2, 3, 4, 8, 16, 32, 128};
    unsigned i = 7;
    while (count < least[i])
        i--;
    return (uint8_t)(1u << i);
}

/* Runs a copy of an input of exactly this length, so that a sanitiser sees any read beyond it. Returns whether it
 * reached anything new. */
static int run(const uint8_t *bytes, size_t length)
{
    int new = 0;
    size_t i;
    running.bytes = malloc(length);
    running.length = length;
    if (length > 0)
        memcpy(running.bytes, bytes, length);
    if (counter_count > 0)
        memset(counters, 0, counter_count);
    (void)LLVMFuzzerTestOneInput(running.bytes, length);
    for (i = 0; i < counter_count; i++)
        if (counters[i] != 0 && (seen[i] & class_of(counters[i])) == 0) {
            seen[i] |= class_of(counters[i]);
            new = 1;
        }
    free(running.bytes);
    return new;
}

static void keep(const uint8_t *bytes, size_t length)
{
    input *added;
    corpus = realloc(corpus, (corpus_count + 1) * sizeof *corpus);
    added = &corpus[corpus_count++];
    added->bytes = malloc(length);
    added->length = length;
    if (length > 0)
        memcpy(added->bytes, bytes, length);
}

/* Puts `count` bytes of `from` into `bytes` at `at`. Returns the new length. */
static size_t insert(uint8_t *bytes, size_t length, size_t at, const uint8_t *from, size_t count)
{
    if (count > MAX_LENGTH - length)
        count = MAX_LENGTH - length;
    memmove(bytes + at + count, bytes + at, length - at);
    memcpy(bytes + at, from, count);
    return length + count;
}

/* Changes something of `bytes`, which have room for MAX_LENGTH. Returns the new length. */
static size_t change(uint8_t *bytes, size_t length)
{
    static const uint8_t extremes[8] = {0, 1, 0x7F, 0x80, 0xFF, 0xFE, 0x40, 0x10};
    const input *other = &corpus[random_below(corpus_count)];
    const size_t at = random_below(length + 1), most = random_below(4) > 0 ? 8 : MAX_LENGTH;
    const size_t left = length - at, from = random_below(other->length + 1);
    size_t count = other->length - from;
    uint8_t byte = (uint8_t)random_below(256);
    if (count > most)
        count = most;
    if (count > 0)
        count = 1 + random_below(count);
    switch (random_below(7)) {
    case 0:
        return insert(bytes, length, at, &byte, 1);
    case 1: /* a piece of another input */
        return insert(bytes, length, at, other->bytes + from, count);
    case 2:
        if (count > left)
            count = left;
        if (count > 0)
            memcpy(bytes + at, other->bytes + from, count);
        return length;
    case 3: /* takes a piece out */
        count = left > most ? most : left;
        count = count > 0 ? 1 + random_below(count) : 0;
        memmove(bytes + at, bytes + at + count, left - count);
        return length - count;
    case 4:
        byte = extremes[byte % sizeof extremes];
        /* fall through */
    case 5:
        if (left > 0)
            bytes[at] = byte;
        return length;
    default:
        if (left > 0)
            bytes[at] = random_below(2) ? bytes[at] ^ (uint8_t)(1u << byte % 8) : (uint8_t)(bytes[at] + byte % 9 - 4);
        return length;
    }
}

/* Reads the corpus. Returns 0 if it is cut. */
static int read_corpus(void)
{
    uint8_t head[4], *bytes;
    size_t length;
    while (fread(head, 1, sizeof head, stdin) == sizeof head) {
        length = head[0] | (size_t)head[1] << 8 | (size_t)head[2] << 16 | (size_t)head[3] << 24;
        bytes = malloc(length);
        if (bytes == NULL || fread(bytes, 1, length, stdin) != length)
            return 0;
        (void)run(bytes, length);
        keep(bytes, length);
        free(bytes);
    }
    return 1;
}

int main(int argument_count, char **arguments)
{
    static const int faults[] = {SIGABRT, SIGFPE, SIGILL, SIGSEGV, SIGTERM};
    static uint8_t changed[MAX_LENGTH];
    const time_t end = time(NULL) + (argument_count == 4 ? strtol(arguments[1], NULL, 10) : 0);
    size_t runs, edges = 0, length, changes, i;
    if (argument_count != 4) {
        fprintf(stderr, "usage: engine SECONDS SEED FILE\n");
        return 2;
    }
    random_state = strtoull(arguments[2], NULL, 10) | 1u; /* never 0 */
    fault_file = arguments[3];
    seen = calloc(1, counter_count + 1);
    (void)LLVMFuzzerInitialize(&argument_count, &arguments);
    for (i = 0; i < sizeof faults / sizeof *faults; i++)
        (void)signal(faults[i], save);
    if (!read_corpus()) {
        fprintf(stderr, "the corpus is cut\n");
        return 2;
    }
    for (runs = corpus_count; corpus_count > 0 && time(NULL) < end; runs++) {
        const input *chosen = &corpus[random_below(corpus_count)];
        length = chosen->length < MAX_LENGTH ? chosen->length : MAX_LENGTH;
        if (length > 0)
            memcpy(changed, chosen->bytes, length);
        for (changes = 1 + random_below(MAX_CHANGES); changes > 0; changes--)
            length = change(changed, length);
        if (run(changed, length))
            keep(changed, length);
    }
    for (i = 0; i < counter_count; i++)
        edges += seen[i] != 0;
    printf("%zu inputs %zu edges\n", runs, edges);
    return 0;
}
