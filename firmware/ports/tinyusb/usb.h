/* A controller on USB with TinyUSB: two ways to the host, a vendor interface and a serial port (CDC).
 *
 * The port calls vc_usb_start() once. usb.c provides vc_port_read() and vc_port_write() of vibrocast/port.h. The
 * host's bytes wait in TinyUSB's buffers; while those are full, USB itself holds the host back.
 */
#ifndef VIBROCAST_USB_H
#define VIBROCAST_USB_H

#include <stdint.h>

/* Your own numbers: docs/how-to/port_the_firmware.md says where to get them. The defaults are those that pid.codes
 * reserves for tests; no product may have them. */
#ifndef VC_USB_VENDOR_ID
#define VC_USB_VENDOR_ID 0x1209
#endif
#ifndef VC_USB_PRODUCT_ID
#define VC_USB_PRODUCT_ID 0x0001
#endif
#ifndef VC_USB_MANUFACTURER
#define VC_USB_MANUFACTURER "vibrocast"
#endif
#ifndef VC_USB_PRODUCT
#define VC_USB_PRODUCT "vibrocast controller"
#endif
/* Bytes of an endpoint: 64 at full speed, 512 at high speed. */
#ifndef VC_USB_PACKET_BYTES
#define VC_USB_PACKET_BYTES 64
#endif
/* The request by which Windows asks for the descriptors that bind WinUSB; any number that no other request has. */
#define VC_USB_MICROSOFT_REQUEST 0x20

enum { VC_USB_SERIAL_CONTROL, VC_USB_SERIAL_DATA, VC_USB_VENDOR, VC_USB_INTERFACES };

/* Begins. `serial_number`: of this board, at most 31 ASCII characters; it must stay valid. NULL: it has none, and the
 * host cannot tell two boards apart. Call tusb_init() after it. */
void vc_usb_start(const char *serial_number);

#endif
