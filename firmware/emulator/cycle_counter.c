/* Counts the instructions and cycles of an emulated processor: a hook on basic blocks for Unicorn, which calls it a
 * million times a second and more, so that it cannot be in Python. harness/boards/cycles.py knows the costs. */
#include <stddef.h>
#include <stdint.h>

#define ENTRIES 65536u /* a power of two, more than a program has blocks */

/* The cost of a block at an address; an address of 0: a free place. */
typedef struct {
    uint32_t address;
    uint16_t instructions, cycles;
} vc_block_cost;

/* `deadline`: cycles at which the emulator is stopped. `jump_cycles`: of a block that does not follow the last one.
 * `stop`: Unicorn's uc_emu_stop. `measure`: fills in `measured` for a block that was never met. */
typedef struct {
    uint64_t instructions, cycles, deadline;
    uint32_t jump_cycles, end; /* `end`: behind the last block */
    int (*stop)(void *emulator);
    void (*measure)(uint32_t address, uint32_t size_bytes);
    vc_block_cost measured;
    vc_block_cost costs[ENTRIES];
} vc_cycle_counter;

size_t vc_cycle_counter_size(void)
{
    return sizeof(vc_cycle_counter);
}

void vc_count_block(void *emulator, uint64_t address, uint32_t size_bytes, vc_cycle_counter *counter)
{
    const uint32_t at = (uint32_t)address;
    uint32_t place = at >> 1 & (ENTRIES - 1);
    vc_block_cost *cost = &counter->costs[place];
    while (cost->address != at && cost->address != 0) {
        place = (place + 1) & (ENTRIES - 1);
        cost = &counter->costs[place];
    }
    if (cost->address == 0) {
        counter->measure(at, size_bytes);
        *cost = counter->measured;
        cost->address = at;
    }
    counter->instructions += cost->instructions;
    counter->cycles += cost->cycles;
    if (at != counter->end)
        counter->cycles += counter->jump_cycles;
    counter->end = at + size_bytes;
    if (counter->cycles >= counter->deadline)
        counter->stop(emulator);
}
