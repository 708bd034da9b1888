/* Shared by all Cortex-M ports: start, registers of the processor itself, interrupts.
 *
 * Registers: Armv7-M Architecture Reference Manual (DDI 0403), B3; the same in Armv8-M (DDI 0553).
 */
#ifndef VIBROCAST_CORTEX_M_H
#define VIBROCAST_CORTEX_M_H

#include <stddef.h>
#include <stdint.h>

/* All of libc that compilers and the firmware call; memory.c. */
void *memcpy(void *destination, const void *source, size_t length);
void *memset(void *destination, int value, size_t length);
int memcmp(const void *one, const void *other, size_t length);

#define VC_REGISTER(address) (*(volatile uint32_t *)(address))

#define VC_SYSTICK_CONTROL VC_REGISTER(0xE000E010) /* SYST_CSR, B3.3.3 */
#define VC_SYSTICK_RELOAD VC_REGISTER(0xE000E014)  /* SYST_RVR, B3.3.4 */
#define VC_SYSTICK_VALUE VC_REGISTER(0xE000E018)   /* SYST_CVR, B3.3.5 */
#define VC_VECTOR_TABLE VC_REGISTER(0xE000ED08)    /* VTOR, B3.2.5 */
#define VC_RESET_CONTROL VC_REGISTER(0xE000ED0C)   /* AIRCR, B3.2.6 */
#define VC_COPROCESSORS VC_REGISTER(0xE000ED88)    /* CPACR, B3.2.20 */

/* Code that runs while flash, which holds all other code, is being erased. */
#define VC_IN_RAM __attribute__((section(".ramfunc"), noinline))

/* A function of such code alone: whatever the optimisation, no compiler leaves it in flash. */
#define VC_INSIDE_RAM static inline __attribute__((always_inline))

/* Memory for the rings between interrupts and the loop and for height profiles. It is not cleared at a start. */
#define VC_CORE_MEMORY __attribute__((section(".core")))

typedef void (*vc_handler)(void); /* of an exception, in a vector table */

extern const uint32_t vc_stack_top[]; /* set by the linker script */

/* The beginning of a vector table (B1.5.3); a board's interrupts follow. */
typedef struct {
    const uint32_t *stack_top;
    vc_handler exceptions[15];
} vc_core_vectors;

/* All except reset and SysTick are faults, or never happen. */
#define VC_CORE_VECTORS(fault, tick)                                                                                   \
    {                                                                                                                  \
        vc_stack_top,                                                                                                  \
        {                                                                                                              \
            Reset_Handler, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault,  \
                tick                                                                                                   \
        }                                                                                                              \
    }

/* Prepares memory and FPU, and calls main(). */
void Reset_Handler(void);

int main(void);

/* Enables an interrupt line of the NVIC (B3.4.4) at a priority, 0 = most urgent to 15. An M0 or M0+ takes whole words
 * alone (Armv6-M manual, DDI 0419, B3.4.7), and of a priority its two highest bits. */
static inline void vc_enable_interrupt(unsigned line, unsigned priority)
{
    const unsigned shift = line % 4 * 8;
    volatile uint32_t *const word = &VC_REGISTER(0xE000E400 + line / 4 * 4);
    *word = (*word & ~(0xFFu << shift)) | (uint32_t)priority << (shift + 4);
    VC_REGISTER(0xE000E100 + line / 32 * 4) = 1u << line % 32;
}

static inline void vc_wait_for_interrupt(void)
{
    __asm volatile("wfi" ::: "memory");
}

#endif
