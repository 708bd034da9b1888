/* The USB descriptors of a controller. USB 2.0, 9.6; CDC 1.2 and PSTN 1.2; Microsoft OS 2.0 Descriptors, 2018. */
#include "usb.h"
#include "tusb.h"

#define LOW(value) ((value) & 0xFF)
#define WORD(value) LOW(value), ((value) >> 8 & 0xFF)

enum { NO_TEXT, MANUFACTURER, PRODUCT, SERIAL_NUMBER, SERIAL_PORT_NAME, VENDOR_NAME };
enum {
    DEVICE = 1,
    CONFIGURATION,
    STRING,
    INTERFACE,
    ENDPOINT,
    ASSOCIATION = 11,
    BOS = 15,
    CAPABILITY,
    CS_INTERFACE = 36
};
enum { BULK = 2, INTERRUPT = 3 };
enum { NOTIFICATION_IN = 0x81, SERIAL_OUT = 0x02, SERIAL_IN = 0x82, VENDOR_OUT = 0x03, VENDOR_IN = 0x83 };

/* clang-format off */
/* Several interfaces that belong together, so the class stands in their association: class 239, subclass 2, protocol 1.
 * USB 2.1, because older devices have no BOS. */
static uint8_t device_bytes[] = {
    18, DEVICE, WORD(0x0210), 239, 2, 1, CFG_TUD_ENDPOINT0_SIZE, /* class, subclass, protocol */
    WORD(VC_USB_VENDOR_ID), WORD(VC_USB_PRODUCT_ID), WORD(0x0100),
    MANUFACTURER, PRODUCT, NO_TEXT, 1,
};
#define SERIAL_NUMBER_PLACE 16

#define ENDPOINT_BYTES(address, kind, packet_bytes, interval) 7, ENDPOINT, address, kind, WORD(packet_bytes), interval
#define CONFIGURATION_BYTES 98

static const uint8_t configuration_bytes[] = {
    9, CONFIGURATION, WORD(CONFIGURATION_BYTES), VC_USB_INTERFACES, 1, NO_TEXT, 0x80, 250, /* from the bus, 500 mA */
    /* The serial port: class 2, abstract control model. */
    8, ASSOCIATION, VC_USB_SERIAL_CONTROL, 2, 2, 2, 0, SERIAL_PORT_NAME,
    9, INTERFACE, VC_USB_SERIAL_CONTROL, 0, 1, 2, 2, 0, SERIAL_PORT_NAME,
    5, CS_INTERFACE, 0, WORD(0x0120),                              /* header: CDC 1.2 */
    5, CS_INTERFACE, 1, 0, VC_USB_SERIAL_DATA,                     /* call management: none */
    4, CS_INTERFACE, 2, 2,                                         /* line coding and state */
    5, CS_INTERFACE, 6, VC_USB_SERIAL_CONTROL, VC_USB_SERIAL_DATA, /* union */
    ENDPOINT_BYTES(NOTIFICATION_IN, INTERRUPT, 8, 16),
    9, INTERFACE, VC_USB_SERIAL_DATA, 0, 2, 10, 0, 0, NO_TEXT,
    ENDPOINT_BYTES(SERIAL_OUT, BULK, VC_USB_PACKET_BYTES, 0),
    ENDPOINT_BYTES(SERIAL_IN, BULK, VC_USB_PACKET_BYTES, 0),
    /* The vendor interface, which the host's `usb:` addresses open. */
    9, INTERFACE, VC_USB_VENDOR, 0, 2, 0xFF, 0, 0, VENDOR_NAME,
    ENDPOINT_BYTES(VENDOR_OUT, BULK, VC_USB_PACKET_BYTES, 0),
    ENDPOINT_BYTES(VENDOR_IN, BULK, VC_USB_PACKET_BYTES, 0),
};

/* The set tells Windows 8.1 and later: bind WinUSB to the vendor interface, and list it under this GUID. */
#define GUID "{6C4EB80D-3F52-4A07-9D1E-7B2058C6FA39}"
#define PROPERTY "DeviceInterfaceGUIDs"
#define PROPERTY_BYTES 42 /* 20 letters and a zero */
#define GUID_BYTES 80     /* 38 characters and two zeros: a list of one */
#define REGISTRY_BYTES (10 + PROPERTY_BYTES + GUID_BYTES)
#define FUNCTION_BYTES (8 + 20 + REGISTRY_BYTES)
#define SET_BYTES (10 + 8 + FUNCTION_BYTES)

static uint8_t microsoft_bytes[SET_BYTES] = {
    WORD(10), WORD(0), 0, 0, 3, 6, WORD(SET_BYTES),           /* set header: Windows 8.1 */
    WORD(8), WORD(1), 0, 0, WORD(8 + FUNCTION_BYTES),         /* subset: configuration 0 */
    WORD(8), WORD(2), VC_USB_VENDOR, 0, WORD(FUNCTION_BYTES), /* subset: function */
    WORD(20), WORD(3), 'W', 'I', 'N', 'U', 'S', 'B', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, /* compatible ID */
    WORD(REGISTRY_BYTES), WORD(4), WORD(7),                   /* property: a list of texts, which vc_usb_start writes */
};

#define BOS_BYTES (5 + 28)

/* One capability of the platform: Microsoft's, {D8DD60DF-4589-4CC7-9CD2-659D9E648A9F}. */
static const uint8_t bos_bytes[] = {
    5, BOS, WORD(BOS_BYTES), 1,
    28, CAPABILITY, 5, 0,
    0xDF, 0x60, 0xDD, 0xD8, 0x89, 0x45, 0xC7, 0x4C, 0x9C, 0xD2, 0x65, 0x9D, 0x9E, 0x64, 0x8A, 0x9F,
    0, 0, 3, 6, WORD(SET_BYTES), VC_USB_MICROSOFT_REQUEST, 0,
};
/* clang-format on */

/* Fails to compile where a length is wrong. */
typedef char vc_check_configuration[sizeof configuration_bytes == CONFIGURATION_BYTES ? 1 : -1];
typedef char vc_check_property[2 * sizeof PROPERTY == PROPERTY_BYTES ? 1 : -1];
typedef char vc_check_guid[2 * sizeof GUID + 2 == GUID_BYTES ? 1 : -1];
typedef char vc_check_bos[sizeof bos_bytes == BOS_BYTES ? 1 : -1];

#define MAX_LETTERS 31

static const char *serial_number;

/* Writes a length and a text of 16-bit letters, with zeros up to this length. Returns the place behind it. */
static uint8_t *write_letters(uint8_t *place, const char *text, unsigned bytes)
{
    unsigned letter;
    *place++ = LOW(bytes);
    *place++ = (uint8_t)(bytes >> 8);
    for (letter = 0; text[letter] != 0; letter++)
        place[2 * letter] = (uint8_t)text[letter];
    return place + bytes;
}

void vc_usb_start(const char *number)
{
    uint8_t *place =
        write_letters(microsoft_bytes + SET_BYTES - PROPERTY_BYTES - GUID_BYTES - 4, PROPERTY, PROPERTY_BYTES);
    (void)write_letters(place, GUID, GUID_BYTES);
    serial_number = number;
    device_bytes[SERIAL_NUMBER_PLACE] = number == NULL ? NO_TEXT : SERIAL_NUMBER;
}

const uint8_t *tud_descriptor_device_cb(void)
{
    return device_bytes;
}

const uint8_t *tud_descriptor_configuration_cb(uint8_t index)
{
    (void)index;
    return configuration_bytes;
}

const uint8_t *tud_descriptor_bos_cb(void)
{
    return bos_bytes;
}

/* Returns a text as TinyUSB wants it: length and kind, then letters of 16 bits. NULL: there is none. */
const uint16_t *tud_descriptor_string_cb(uint8_t index, uint16_t language)
{
    static uint16_t letters[1 + MAX_LETTERS];
    const char *const texts[] = {[MANUFACTURER] = VC_USB_MANUFACTURER,
                                 [PRODUCT] = VC_USB_PRODUCT,
                                 [SERIAL_NUMBER] = serial_number,
                                 [SERIAL_PORT_NAME] = VC_USB_PRODUCT " (serial)",
                                 [VENDOR_NAME] = VC_USB_PRODUCT " (vendor)"};
    unsigned count = 0;
    (void)language;
    if (index == 0) {
        letters[1] = 0x0409; /* English is the only language */
        count = 1;
    } else if (index < sizeof texts / sizeof *texts && texts[index] != NULL) {
        for (; count < MAX_LETTERS && texts[index][count] != 0; count++)
            letters[1 + count] = (uint8_t)texts[index][count];
    } else {
        return NULL;
    }
    letters[0] = (uint16_t)(STRING << 8 | (2 + 2 * count));
    return letters;
}

/* Requests to the device as a vendor defines them: Windows asks for its descriptors by index 7. All others stall. */
bool tud_vendor_control_xfer_cb(uint8_t port, uint8_t stage, const tusb_control_request_t *request)
{
    if (stage != CONTROL_STAGE_SETUP)
        return true;
    if (request->bRequest != VC_USB_MICROSOFT_REQUEST || request->wIndex != 7)
        return false;
    return tud_control_xfer(port, request, microsoft_bytes, sizeof microsoft_bytes);
}
