/* A stand-in for TinyUSB, and the host behind it: each way is a buffer, and a flush hands its bytes to the host. */
#include "tusb.h"
#include <string.h>

enum { VENDOR, SERIAL, WAYS };

typedef struct {
    uint8_t bytes[4096];
    uint32_t count;
} buffer;

static buffer from_host[WAYS], to_host[WAYS], at_host[WAYS];
static unsigned tasks;

static uint32_t put(buffer *to, const void *data, uint32_t length, uint32_t capacity)
{
    const uint32_t room = capacity - to->count, taken = length < room ? length : room;
    memcpy(to->bytes + to->count, data, taken);
    to->count += taken;
    return taken;
}

static uint32_t take(buffer *from, void *data, uint32_t capacity)
{
    const uint32_t taken = from->count < capacity ? from->count : capacity;
    memcpy(data, from->bytes, taken);
    from->count -= taken;
    memmove(from->bytes, from->bytes + taken, from->count);
    return taken;
}

static uint32_t flush(int way)
{
    const uint32_t moved = put(&at_host[way], to_host[way].bytes, to_host[way].count, sizeof at_host[way].bytes);
    uint8_t sent[sizeof to_host[way].bytes];
    (void)take(&to_host[way], sent, moved);
    return moved;
}

/* What a test does as the host. */
uint32_t host_write(int way, const void *data, uint32_t length)
{
    return put(&from_host[way], data, length, CFG_TUD_VENDOR_RX_BUFSIZE);
}

uint32_t host_read(int way, void *data, uint32_t capacity)
{
    return take(&at_host[way], data, capacity);
}

unsigned tasks_run(void)
{
    return tasks;
}

static uint8_t answer[512];
static uint16_t answered;

/* Returns the bytes of the answer to a vendor request to the device, -1 if it stalls. */
int host_vendor_request(uint8_t number, uint16_t index, uint8_t *data)
{
    const tusb_control_request_t request = {0xC0, number, 0, index, sizeof answer};
    answered = 0;
    if (!tud_vendor_control_xfer_cb(0, CONTROL_STAGE_SETUP, &request))
        return -1;
    if (!tud_vendor_control_xfer_cb(0, CONTROL_STAGE_DATA, &request))
        return -1;
    memcpy(data, answer, answered);
    return answered;
}

bool tud_control_xfer(uint8_t rhport, tusb_control_request_t const *request, void *data, uint16_t len)
{
    (void)rhport;
    answered = len < request->wLength ? len : request->wLength;
    memcpy(answer, data, answered);
    return true;
}

void tud_task(void)
{
    tasks++;
}

uint32_t tud_vendor_n_read(uint8_t itf, void *data, uint32_t bufsize)
{
    return itf == 0 ? take(&from_host[VENDOR], data, bufsize) : 0;
}

uint32_t tud_vendor_n_write(uint8_t itf, void const *data, uint32_t bufsize)
{
    return itf == 0 ? put(&to_host[VENDOR], data, bufsize, CFG_TUD_VENDOR_TX_BUFSIZE) : 0;
}

uint32_t tud_vendor_n_write_flush(uint8_t itf)
{
    return itf == 0 ? flush(VENDOR) : 0;
}

uint32_t tud_cdc_n_read(uint8_t itf, void *data, uint32_t bufsize)
{
    return itf == 0 ? take(&from_host[SERIAL], data, bufsize) : 0;
}

uint32_t tud_cdc_n_write(uint8_t itf, void const *data, uint32_t bufsize)
{
    return itf == 0 ? put(&to_host[SERIAL], data, bufsize, CFG_TUD_CDC_TX_BUFSIZE) : 0;
}

uint32_t tud_cdc_n_write_flush(uint8_t itf)
{
    return itf == 0 ? flush(SERIAL) : 0;
}
