/* libFuzzer's interface: a program with these functions runs under libFuzzer, and under engine.c where it is absent. */
#ifndef VIBROCAST_FUZZ_ENGINE_H
#define VIBROCAST_FUZZ_ENGINE_H

#include <stddef.h>
#include <stdint.h>

int LLVMFuzzerInitialize(int *argument_count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t length);

#endif
