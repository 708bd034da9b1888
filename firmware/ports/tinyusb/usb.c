/* The controller's bytes over TinyUSB: vc_port_read() and vc_port_write() of vibrocast/port.h. */
#include "usb.h"
#include "tusb.h"
#include "vibrocast/port.h"

/* Where the host's last bytes came from; answers go there. */
static int uses_serial;

/* Runs TinyUSB, so call it at each turn of the loop. The vendor interface comes first. */
size_t vc_port_read(uint8_t *data, size_t capacity)
{
    uint32_t came;
    int serial = 0;
    tud_task();
    came = tud_vendor_n_read(0, data, (uint32_t)capacity);
    if (came == 0) {
        came = tud_cdc_n_read(0, data, (uint32_t)capacity);
        serial = 1;
    }
    if (came > 0)
        uses_serial = serial;
    return came;
}

/* Bytes that no host takes fill TinyUSB's buffer; then it takes no more. */
size_t vc_port_write(const uint8_t *data, size_t length)
{
    uint32_t taken;
    if (length == 0)
        return 0;
    if (uses_serial) {
        taken = tud_cdc_n_write(0, data, (uint32_t)length);
        (void)tud_cdc_n_write_flush(0);
    } else {
        taken = tud_vendor_n_write(0, data, (uint32_t)length);
        (void)tud_vendor_n_write_flush(0);
    }
    return taken;
}
