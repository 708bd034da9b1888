/* The table of targets, and their shared functions; see targets.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "engine.h"
#include "targets.h"

static const struct {
    const char *name;
    vc_fuzz_target run;
} targets[] = {
#define ROW(name) {#name, vc_fuzz_##name},
    VC_CODECS(ROW) ROW(streams) ROW(frames) ROW(messages) ROW(headers) ROW(images) ROW(output) ROW(profile) ROW(flash)
        ROW(controller)};

static vc_fuzz_target chosen;

int LLVMFuzzerInitialize(int *argument_count, char ***arguments)
{
    const char *name = getenv("FUZZ_TARGET");
    size_t i;
    (void)argument_count;
    (void)arguments;
    for (i = 0; i < sizeof targets / sizeof *targets; i++)
        if (name != NULL && strcmp(name, targets[i].name) == 0)
            chosen = targets[i].run;
    if (chosen == NULL) {
        fprintf(stderr, "set FUZZ_TARGET to the name of a target of firmware/fuzz/targets.c\n");
        exit(2);
    }
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length)
{
    chosen(data, length);
    return 0;
}

int vc_fuzz_record(const uint8_t **data, size_t *length, uint8_t **record, size_t *record_length)
{
    if (*length < 2)
        return 0;
    *record_length = (size_t)((*data)[0] | (*data)[1] << 8);
    *data += 2;
    *length -= 2;
    if (*record_length > *length)
        *record_length = *length;
    *record = malloc(*record_length);
    if (*record_length > 0)
        memcpy(*record, *data, *record_length);
    *data += *record_length;
    *length -= *record_length;
    return 1;
}

void vc_fuzz_check(int holds, const char *what)
{
    if (!holds) {
        fprintf(stderr, "%s\n", what);
        abort();
    }
}
