/* A port for an emulated controller: bytes, time and codes lie in memory. */
#include "vibrocast/actuator_tables.h"
#include "vibrocast/port.h"

#define LINE_BYTES 4096

void *memcpy(void *destination, const void *source, size_t length);
void vc_memory_port_start(void);

/* The emulator writes the time and `incoming`, and reads `outgoing`; `read` of `incoming_bytes` are taken. */
struct {
    uint64_t now_us;
    uint32_t incoming_bytes, read, outgoing_bytes, played;
    uint8_t incoming[LINE_BYTES], outgoing[LINE_BYTES];
} vc_memory_port;

size_t vc_port_read(uint8_t *data, size_t capacity)
{
    const size_t left = vc_memory_port.incoming_bytes - vc_memory_port.read;
    const size_t length = capacity < left ? capacity : left;
    memcpy(data, vc_memory_port.incoming + vc_memory_port.read, length);
    vc_memory_port.read += (uint32_t)length;
    return length;
}

size_t vc_port_write(const uint8_t *data, size_t length)
{
    const size_t room = LINE_BYTES - vc_memory_port.outgoing_bytes;
    length = length < room ? length : room;
    memcpy(vc_memory_port.outgoing + vc_memory_port.outgoing_bytes, data, length);
    vc_memory_port.outgoing_bytes += (uint32_t)length;
    return length;
}

uint64_t vc_port_now_us(void)
{
    return vc_memory_port.now_us;
}

static void play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    (void)context;
    (void)codes;
    (void)channels;
    (void)due_us;
    vc_memory_port.played += samples;
}

void vc_memory_port_start(void)
{
    static const vc_controller_settings settings = {
        .build = VC_BUILD,
        .hardware = "emulated",
        .actuator = &vc_piezo_stack,
        .watchdog_ms = 2000,
    };
    static const vc_dac_port dac = {.play = play};
    vc_loop_start(&settings, NULL, &dac);
}
