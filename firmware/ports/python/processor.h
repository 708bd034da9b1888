/* Asks a processor which of the compiled cores it runs; vibrocast.firmware.native_core loads one of them. */
#ifndef VIBROCAST_PROCESSOR_H
#define VIBROCAST_PROCESSOR_H

#include <stdint.h>

/* cffi: begin */
/* Returns 1 if this processor and its operating system run code for x86-64-v3 (AVX2, FMA, BMI and others), else 0. */
int vc_runs_x86_64_v3(void);

/* Returns the same for a processor with these registers: ECX of CPUID leaf 1, EBX of leaf 7, ECX of leaf 0x80000001,
 * and the low half of XCR0. */
int vc_registers_run_x86_64_v3(uint32_t leaf_1_ecx, uint32_t leaf_7_ebx, uint32_t leaf_80000001_ecx, uint32_t xcr0);
/* cffi: end */

#endif
