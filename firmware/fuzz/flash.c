/* Target: the image store over a flash with any contents, and requests to it. */
#include <stdlib.h>
#include <string.h>

#include "vibrocast/actuator_tables.h"
#include "../src/core/vc_crc.h"
#include "../src/controller/vc_image_store.h"
#include "targets.h"

enum { WRITE_BYTES = 8, PIECE_BYTES = 256, SLOT_BYTES = 2048, FLASH_BYTES = 2 * PIECE_BYTES + 2 * SLOT_BYTES };
enum { ENTRY_BYTES = VC_SLOT_ENTRY_BYTES - 4 /* a CRC-32 */ };
enum { BEGIN, WRITE, VERIFY, ACTIVATE, CONFIRM, ERASE, READ, RESTART, REQUESTS };

typedef struct {
    uint8_t bytes[FLASH_BYTES];
    unsigned changes_until_cut;
} flash_memory;

static int takes(flash_memory *memory)
{
    return memory->changes_until_cut > 0 && memory->changes_until_cut-- > 0;
}

static int erase(void *context, uint32_t offset, uint32_t length)
{
    flash_memory *memory = context;
    vc_fuzz_check(offset % PIECE_BYTES == 0 && length % PIECE_BYTES == 0 && offset + length <= FLASH_BYTES,
                  "erasing what is no piece of the flash");
    if (!takes(memory))
        return 1;
    memset(memory->bytes + offset, 0xFF, length);
    return 0;
}

static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    flash_memory *memory = context;
    uint32_t i;
    vc_fuzz_check(offset <= FLASH_BYTES && length <= FLASH_BYTES - offset, "programming beyond the flash");
    vc_fuzz_check(offset % WRITE_BYTES == 0 && length % WRITE_BYTES == 0, "programming a part of a write");
    if (!takes(memory))
        return 1;
    for (i = 0; i < length; i++)
        memory->bytes[offset + i] &= data[i];
    return 0;
}

static int check(const void *context, uint8_t codec, const uint8_t *payload, size_t length, vc_rejection *rejection)
{
    (void)context;
    return length > 0 && payload[0] == codec ? vc_reject(rejection, VC_IMAGE_REJECTED, "no tables of this codec") : 0;
}

static void boot(vc_image_store *store, const vc_flash *flash)
{
    vc_image_description description;
    const vc_model_image *image;
    unsigned number;
    vc_image_store_boot(store);
    image = vc_image_store_running(store);
    vc_fuzz_check((image != NULL) == (vc_image_store_running_sha256(store) != NULL), "an image without its hash");
    if (image != NULL)
        vc_fuzz_check(image->payload.bytes >= flash->base && image->payload.length < SLOT_BYTES &&
                          image->payload.bytes + image->payload.length <= flash->base + FLASH_BYTES,
                      "an image beyond the flash");
    for (number = 0; number < VC_SLOTS; number++) {
        vc_image_store_describe(store, number, &description);
        vc_fuzz_check(description.state <= VC_SLOT_CONFIRMED && vc_is_utf8(description.name), "no description");
    }
}

static void dispatch(vc_image_store *store, const vc_flash *flash, const uint8_t *record, size_t length)
{
    unsigned request = record[0] % REQUESTS, slot = record[0] / REQUESTS % (VC_SLOTS + 1);
    vc_piece rest = {record + 1, length - 1};
    vc_flash_begin begin = {(uint8_t)slot, 0, NULL, {NULL, 0}};
    vc_flash_data data = {(uint8_t)slot, 0, {NULL, 0}};
    vc_flash_read read = {(uint8_t)slot, 0, 0};
    vc_flash_contents contents;
    vc_flash_status report;
    vc_rejection rejection;
    vc_fields fields;
    uint8_t sha256[VC_SHA256_BYTES];
    int code = 0;
    vc_fields_begin(&fields, rest.bytes, rest.length);
    switch (request) {
    case BEGIN:
        /* The rest is the image itself. */
        vc_sha256(rest.bytes, vc_model_image_unsigned_bytes(rest.bytes, rest.length), sha256);
        begin.size_bytes = (uint32_t)rest.length;
        begin.sha256 = sha256;
        code = vc_image_store_begin(store, &begin, &report, &rejection);
        break;
    case WRITE:
        data.offset = (uint32_t)vc_take_number(&fields, 2);
        data.data = fields.rest;
        if (!fields.cut)
            code = vc_image_store_write(store, &data, &report, &rejection);
        break;
    case VERIFY:
        code = vc_image_store_verify(store, slot, &report, &rejection);
        break;
    case ACTIVATE:
        code = vc_image_store_activate(store, slot, &report, &rejection);
        break;
    case CONFIRM:
        code = vc_image_store_confirm(store, slot, &report, &rejection);
        break;
    case ERASE:
        code = vc_image_store_erase(store, slot, &report, &rejection);
        break;
    case READ:
        read.offset = (uint32_t)vc_take_number(&fields, 4);
        read.count = (uint16_t)vc_take_number(&fields, 2);
        code = vc_image_store_read(store, &read, &contents, &rejection);
        vc_fuzz_check(code != 0 || (contents.data.length <= read.count && contents.data.bytes >= flash->base &&
                                    contents.data.bytes + contents.data.length <= flash->base + FLASH_BYTES),
                      "bytes beyond the flash");
        break;
    default:
        ((flash_memory *)flash->context)->changes_until_cut = (unsigned)vc_take_number(&fields, 1);
        boot(store, flash);
    }
    if (code != 0)
        vc_fuzz_check(code == rejection.code && rejection.length > 0, "a rejection without a reason");
}

void vc_fuzz_flash(const uint8_t *data, size_t length)
{
    flash_memory *memory = malloc(sizeof *memory);
    vc_flash flash = {memory->bytes, {0, PIECE_BYTES}, PIECE_BYTES, {2 * PIECE_BYTES, 2 * PIECE_BYTES + SLOT_BYTES},
                      SLOT_BYTES,    WRITE_BYTES,      erase,       program,
                      memory};
    static const struct {
        uint32_t offset, room;
    } parts[] = {{0, ENTRY_BYTES},
                 {PIECE_BYTES, ENTRY_BYTES},
                 {2 * PIECE_BYTES, SLOT_BYTES},
                 {2 * PIECE_BYTES + SLOT_BYTES, SLOT_BYTES}};
    static const vc_controller_settings settings = {.hardware = "board", .actuator = &vc_piezo_stack};
    vc_image_store *store = malloc(sizeof *store);
    uint8_t *record;
    size_t record_length;
    unsigned part;
    memset(memory->bytes, 0xFF, sizeof memory->bytes);
    memory->changes_until_cut = 1000;
    for (part = 0; part < 4 && vc_fuzz_record(&data, &length, &record, &record_length); part++) {
        if (record_length > parts[part].room)
            record_length = parts[part].room;
        if (record_length > 0)
            memcpy(memory->bytes + parts[part].offset, record, record_length);
        free(record);
    }
    for (part = 0; part < 2; part++)
        vc_number_bytes(memory->bytes + parts[part].offset + ENTRY_BYTES,
                        vc_crc32(memory->bytes + parts[part].offset, ENTRY_BYTES, 0), 4);
    vc_image_store_init(store, &flash, &settings, check, NULL);
    boot(store, &flash);
    while (vc_fuzz_record(&data, &length, &record, &record_length)) {
        if (record_length > 0)
            dispatch(store, &flash, record, record_length);
        free(record);
    }
    free(store);
    free(memory);
}
