/* TinyUSB's settings: a vendor interface and a serial port. Define CFG_TUSB_MCU by -D. */
#ifndef VIBROCAST_TUSB_CONFIG_H
#define VIBROCAST_TUSB_CONFIG_H

#include "usb.h"

#define CFG_TUSB_OS OPT_OS_NONE
#define CFG_TUSB_RHPORT0_MODE OPT_MODE_DEVICE
#define CFG_TUD_ENABLED 1
#define CFG_TUD_ENDPOINT0_SIZE 64

#define CFG_TUD_CDC 1
#define CFG_TUD_VENDOR 1
#define CFG_TUD_HID 0
#define CFG_TUD_MIDI 0
#define CFG_TUD_MSC 0

/* The host's bytes wait here while a block is decoded. */
#define CFG_TUD_VENDOR_EPSIZE VC_USB_PACKET_BYTES
#define CFG_TUD_VENDOR_RX_BUFSIZE 4096
#define CFG_TUD_VENDOR_TX_BUFSIZE 1024
#define CFG_TUD_CDC_EP_BUFSIZE VC_USB_PACKET_BYTES
#define CFG_TUD_CDC_RX_BUFSIZE 4096
#define CFG_TUD_CDC_TX_BUFSIZE 1024

#endif
