/* Two slots for model images in flash; see vc_image_store.h.
 *
 * A slot is erased and written only while the record calls it empty or in writing, and neither the slot that runs nor
 * the one to fall back to is.
 */
#include "vc_image_store.h"

#include "../core/vc_common.h"
#include "../core/vc_crc.h"

#define NO_SLOT (-1)

static const vc_slot empty_slot = {VC_SLOT_EMPTY, 0, 0, {0}};

unsigned vc_image_store_slots(const vc_image_store *store)
{
    return store->record.flash != NULL ? VC_SLOTS : 0;
}

static const vc_slot *slot_of(const vc_image_store *store, unsigned number)
{
    return &store->record.entry.slots[number];
}

static const uint8_t *slot_data(const vc_image_store *store, unsigned number)
{
    const vc_flash *flash = store->record.flash;
    return flash->base + flash->slot[number];
}

/* Changes the record, all at once. The record comes first, so that a failing flash changes nothing. Returns whether
 * the flash took it. */
static int set_entry(vc_image_store *store, const vc_slot_entry *entry)
{
    unsigned i;
    store->changes++;
    if (!vc_slot_record_append(&store->record, entry))
        return 0;
    for (i = 0; i < VC_SLOTS; i++)
        if (entry->slots[i].state == VC_SLOT_EMPTY) {
            store->written[i] = 0;
            store->whole[i] = 0;
        }
    return 1;
}

static int set_slot(vc_image_store *store, unsigned number, const vc_slot *slot)
{
    vc_slot_entry entry = store->record.entry;
    entry.slots[number] = *slot;
    return set_entry(store, &entry);
}

/* Checks the signature of an image, where the controller has a key. Returns 0, or the rejection's code. */
static int check_signature(const vc_image_store *store, const vc_model_image *image, const uint8_t *sha256,
                           vc_rejection *rejection)
{
    const vc_controller_settings *settings = store->settings;
    uint8_t message[VC_SIGNED_MESSAGE_BYTES];
    if (settings->public_key == NULL)
        return 0;
    if (image->signature == NULL)
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "the image has no signature, and this controller takes signed images only: sign it");
    memcpy(message, sha256, VC_SHA256_BYTES);
    vc_number_bytes(message + VC_SHA256_BYTES, image->number, 4);
    if (settings->verify_signature(settings->verify_context, settings->public_key, image->signature, message) != 1)
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "the image's signature is not by this controller's key: sign it with that key");
    return 0;
}

/* Whether a later image than this one has been confirmed already. */
static int is_outdated(const vc_image_store *store, const vc_model_image *image)
{
    return store->settings->public_key != NULL && image->number < store->record.entry.lowest_number;
}

static int reject_outdated(const vc_image_store *store, const vc_model_image *image, vc_rejection *rejection)
{
    return is_outdated(store, image)
               ? vc_reject_numbers(rejection, VC_IMAGE_REJECTED,
                                   "the image has number #, and # was confirmed before: take a later image",
                                   image->number, store->record.entry.lowest_number)
               : 0;
}

/* Checks a slot's image, and reads it in place. Returns 0 for a whole one, or the rejection's code. */
static int look_at_image(vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    const vc_slot *slot = slot_of(store, number);
    const uint8_t *data = slot_data(store, number);
    vc_model_image *image = &store->images[number];
    uint8_t sha256[VC_SHA256_BYTES];
    int rejected;
    store->whole[number] = 0;
    vc_sha256(data, vc_model_image_unsigned_bytes(data, slot->size_bytes), sha256);
    if (!vc_same_bytes(sha256, slot->sha256, VC_SHA256_BYTES))
        return vc_reject(rejection, VC_IMAGE_REJECTED,
                         "what was written has another SHA-256 than announced: flash it again");
    rejected = vc_model_image_read(image, data, slot->size_bytes, rejection);
    if (!rejected)
        rejected = check_signature(store, image, sha256, rejection);
    store->whole[number] = !rejected;
    return rejected;
}

/* The slot in this state whose image is whole and not outdated, or NO_SLOT. */
static int whole_slot(const vc_image_store *store, uint8_t state)
{
    int number;
    for (number = 0; number < VC_SLOTS; number++)
        if (slot_of(store, (unsigned)number)->state == state && store->whole[number] &&
            !is_outdated(store, &store->images[number]))
            return number;
    return NO_SLOT;
}

void vc_image_store_init(vc_image_store *store, const vc_flash *flash, const vc_controller_settings *settings,
                         vc_payload_check check, const void *check_context)
{
    memset(store, 0, sizeof *store);
    store->record.flash = flash;
    store->settings = settings;
    store->check = check;
    store->check_context = check_context;
    vc_image_store_boot(store);
}

void vc_image_store_boot(vc_image_store *store)
{
    vc_slot_entry entry;
    vc_rejection unused;
    int changed = 0, spare;
    unsigned i;
    store->running = NO_SLOT;
    if (vc_image_store_slots(store) == 0)
        return;
    vc_slot_record_open(&store->record, store->record.flash);
    for (i = 0; i < VC_SLOTS; i++) {
        store->whole[i] = store->erased[i] = 0;
        store->written[i] = 0;
        if (slot_of(store, i)->state > VC_SLOT_WRITING)
            look_at_image(store, i, &unused);
    }
    /* Notes broken images. Ends a trial that was not confirmed; notes the first start of a new one. */
    entry = store->record.entry;
    spare = whole_slot(store, VC_SLOT_VERIFIED);
    for (i = 0; i < VC_SLOTS; i++) {
        vc_slot *slot = &entry.slots[i];
        if (slot->state != VC_SLOT_TESTING && slot->state != VC_SLOT_CONFIRMED)
            continue;
        if (!store->whole[i] || is_outdated(store, &store->images[i])) {
            if (slot->state == VC_SLOT_CONFIRMED && spare != NO_SLOT)
                entry.slots[spare].state = VC_SLOT_CONFIRMED;
            *slot = empty_slot;
            changed = 1;
        } else if (slot->state == VC_SLOT_TESTING) {
            slot->state = slot->booted ? VC_SLOT_VERIFIED : VC_SLOT_TESTING;
            slot->booted = !slot->booted;
            changed = 1;
        }
    }
    /* Without a record of it, a test would never end. */
    if (!changed || set_entry(store, &entry))
        store->running = whole_slot(store, VC_SLOT_TESTING);
    if (store->running == NO_SLOT)
        store->running = whole_slot(store, VC_SLOT_CONFIRMED);
}

const vc_model_image *vc_image_store_running(const vc_image_store *store)
{
    return store->running == NO_SLOT ? NULL : &store->images[store->running];
}

const uint8_t *vc_image_store_running_sha256(const vc_image_store *store)
{
    return store->running == NO_SLOT ? NULL : slot_of(store, (unsigned)store->running)->sha256;
}

/* The actuator of an image: the last bytes of the payload, in the layout and alignment of the structure. An image never
 * lifts a limit of the settings, signed or not, nor changes the clock and the codes that the port has set up. Returns
 * NULL and fills the rejection if the controller cannot drive it. */
static const vc_actuator *actuator_of(const vc_model_image *image, const vc_actuator *own, vc_rejection *rejection)
{
    const vc_actuator *actuator = NULL;
    if (image->payload.length >= sizeof *actuator) {
        const uint8_t *at = image->payload.bytes + image->payload.length - sizeof *actuator;
        if ((uintptr_t)at % sizeof(uint32_t) == 0)
            actuator = (const vc_actuator *)(const void *)at;
    }
    if (actuator == NULL || !vc_actuator_is_usable(actuator))
        vc_reject(rejection, VC_IMAGE_REJECTED, "the image holds no actuator that can be driven: pack it again");
    else if (actuator->dac_bits != own->dac_bits || actuator->dac_rate_hz != own->dac_rate_hz)
        vc_reject_numbers(rejection, VC_IMAGE_REJECTED,
                          "the image's actuator is for another DAC; here it has # bits and # Hz: change the file",
                          own->dac_bits, own->dac_rate_hz);
    else if (actuator->code_limit > own->code_limit || actuator->code_step_limit > own->code_step_limit ||
             actuator->power_limit > own->power_limit)
        vc_reject(rejection, VC_IMAGE_REJECTED,
                  "the image's actuator has wider limits than the firmware: lower those of voltage, slew and power");
    else
        return actuator;
    return NULL;
}

const vc_actuator *vc_image_store_actuator(const vc_image_store *store)
{
    const vc_model_image *image = vc_image_store_running(store);
    const vc_actuator *own = store->settings->actuator, *actuator = NULL;
    vc_rejection unused;
    if (image != NULL && image->codec == VC_IMAGE_OF_ACTUATOR)
        actuator = actuator_of(image, own, &unused);
    return actuator != NULL ? actuator : own;
}

void vc_image_store_describe(const vc_image_store *store, unsigned number, vc_image_description *description)
{
    memset(description, 0, sizeof *description);
    description->slot = (uint8_t)number;
    description->state = slot_of(store, number)->state;
    description->sha256 = slot_of(store, number)->sha256;
    if (description->state > VC_SLOT_WRITING && store->whole[number]) {
        description->name = store->images[number].name;
        description->version = store->images[number].version;
        description->number = store->images[number].number;
    }
}

static int no_such_slot(const vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    if (vc_image_store_slots(store) == 0)
        return vc_reject(rejection, VC_NO_SUCH_SLOT, "there is no slot: this controller has no flash for model images");
    return number < VC_SLOTS ? 0
                             : vc_reject_numbers(rejection, VC_NO_SUCH_SLOT, "there is no slot #; slots are 0 to #",
                                                 number, VC_SLOTS - 1);
}

static int not_in_state(const vc_image_store *store, unsigned number, uint8_t state, const char *hint,
                        vc_rejection *rejection)
{
    static const char *const names[] = {"empty", "writing", "verified", "testing", "confirmed"};
    int rejected = no_such_slot(store, number, rejection);
    if (rejected || slot_of(store, number)->state == state)
        return rejected;
    vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # is ", number, 0);
    vc_rejection_add(rejection, names[slot_of(store, number)->state]);
    return vc_rejection_add(rejection, hint);
}

/* Rejects a change of the record beyond VC_FLASH_CHANGES, which bounds the wear by a hostile host. */
static int reject_wear(const vc_image_store *store, vc_rejection *rejection)
{
    return store->changes < VC_FLASH_CHANGES
               ? 0
               : vc_reject_numbers(rejection, VC_WRONG_STATE,
                                   "the flash was changed # times since power-on: switch the controller off and on",
                                   VC_FLASH_CHANGES, 0);
}

/* Rejects a request while an image is being tested: only a FlashConfirm or a restart ends that. */
static int reject_while_testing(const vc_image_store *store, vc_rejection *rejection)
{
    unsigned i;
    for (i = 0; i < VC_SLOTS; i++)
        if (slot_of(store, i)->state == VC_SLOT_TESTING)
            return vc_reject_numbers(rejection, VC_WRONG_STATE,
                                     "slot # is being tested: confirm it, or switch the controller off and on", i, 0);
    return 0;
}

static int flash_failed(vc_rejection *rejection)
{
    return vc_reject(rejection, VC_FLASH_FAILED,
                     "the flash did not take the data: try again; if it goes on failing, the flash is worn out");
}

static int wrong_hardware(const vc_image_store *store, vc_piece wanted, enum vc_error_code code,
                          vc_rejection *rejection)
{
    vc_piece hardware = vc_text_piece(store->settings->hardware);
    if (wanted.length == 0 ||
        (wanted.length == hardware.length && vc_same_bytes(wanted.bytes, hardware.bytes, wanted.length)))
        return 0;
    vc_reject(rejection, code, "this controller is ");
    vc_rejection_add_piece(rejection, hardware);
    vc_rejection_add(rejection, ", the image is for ");
    return vc_rejection_add_piece(rejection, wanted);
}

/* Whether a slot takes data of its image. Not after a boot or a failed write: a place may then be half written, and
 * the slot must be erased first. */
static int is_taking(const vc_image_store *store, unsigned number)
{
    return slot_of(store, number)->state == VC_SLOT_WRITING && (store->erased[number] || store->written[number] > 0);
}

static int tell(const vc_image_store *store, unsigned number, vc_flash_status *report)
{
    const vc_slot *slot = slot_of(store, number);
    report->slot = (uint8_t)number;
    report->state = slot->state;
    report->next_offset = is_taking(store, number) ? store->written[number] : 0;
    report->sha256 = slot->state > VC_SLOT_WRITING ? slot->sha256 : NULL;
    return 0;
}

/* Rejects a change of the slot that runs, or that is the one to fall back to. */
static int reject_in_use(const vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    int rejected;
    if ((int)number != store->running && slot_of(store, number)->state != VC_SLOT_CONFIRMED)
        return 0;
    rejected = reject_while_testing(store, rejection);
    return rejected ? rejected
                    : vc_reject_numbers(rejection, VC_WRONG_STATE,
                                        "slot # runs or is the one to fall back to: use the other", number, 0);
}

/* Empties a slot, in the record first. Returns 0, or the rejection's code. */
static int erase_slot(vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    const vc_flash *flash = store->record.flash;
    if ((slot_of(store, number)->state != VC_SLOT_EMPTY && !set_slot(store, number, &empty_slot)) ||
        (!store->erased[number] && flash->erase(flash->context, flash->slot[number], flash->slot_bytes) != 0))
        return flash_failed(rejection);
    store->erased[number] = 1;
    store->written[number] = 0;
    return 0;
}

int vc_image_store_begin(vc_image_store *store, const vc_flash_begin *begin, vc_flash_status *report,
                         vc_rejection *rejection)
{
    const vc_flash *flash = store->record.flash;
    const unsigned number = begin->slot;
    const vc_slot *slot;
    vc_slot wanted = {VC_SLOT_WRITING, 0, begin->size_bytes, {0}};
    int rejected = no_such_slot(store, number, rejection);
    if (rejected)
        return rejected;
    slot = slot_of(store, number);
    rejected = reject_in_use(store, number, rejection);
    if (!rejected)
        rejected = wrong_hardware(store, begin->hardware, VC_WRONG_HARDWARE, rejection);
    if (rejected)
        return rejected;
    if (begin->size_bytes == 0 || begin->size_bytes > flash->slot_bytes)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS, "an image of # bytes; a slot holds 1 to #",
                                 begin->size_bytes, flash->slot_bytes);
    memcpy(wanted.sha256, begin->sha256, VC_SHA256_BYTES);
    if (!is_taking(store, number) || slot->size_bytes != wanted.size_bytes ||
        !vc_same_bytes(slot->sha256, wanted.sha256, VC_SHA256_BYTES)) {
        rejected = reject_wear(store, rejection);
        if (!rejected && !store->erased[number])
            rejected = erase_slot(store, number, rejection);
        if (rejected)
            return rejected;
        if (!set_slot(store, number, &wanted))
            return flash_failed(rejection);
    }
    return tell(store, number, report);
}

/* Rejects what only a slot that takes an image does. */
static int reject_unless_taking(const vc_image_store *store, unsigned number, const char *hint, vc_rejection *rejection)
{
    int rejected = not_in_state(store, number, VC_SLOT_WRITING, hint, rejection);
    return rejected || is_taking(store, number)
               ? rejected
               : vc_reject_numbers(rejection, VC_WRONG_STATE,
                                   "slot # was not written to its end: begin with FlashBegin", number, 0);
}

/* Programs whole writes of the flash. Returns whether it took them; if not, the slot must be erased. */
static int program_whole(vc_image_store *store, unsigned number, uint32_t offset, const uint8_t *data, uint32_t length)
{
    const vc_flash *flash = store->record.flash;
    const int taken = flash->program(flash->context, flash->slot[number] + offset, data, length) == 0;
    store->erased[number] = 0;
    store->written[number] = taken ? offset + length : 0;
    return taken;
}

/* Programs data in whole writes of the flash. What is left over waits for the next data; at the end of an image it is
 * filled up. Returns whether the flash took them. */
static int program(vc_image_store *store, const vc_flash_data *data)
{
    const uint32_t write_bytes = store->record.flash->write_bytes;
    const uint32_t length = (uint32_t)data->data.length, rest = length % write_bytes, end = data->offset + length;
    uint8_t last[VC_MOST_WRITE_BYTES];
    int taken = 1;
    if (length > rest)
        taken = program_whole(store, data->slot, data->offset, data->data.bytes, length - rest);
    if (taken && rest > 0 && end == slot_of(store, data->slot)->size_bytes) {
        memset(last, 0xFF, sizeof last);
        memcpy(last, data->data.bytes + length - rest, rest);
        taken = program_whole(store, data->slot, end - rest, last, write_bytes);
    }
    return taken;
}

int vc_image_store_write(vc_image_store *store, const vc_flash_data *data, vc_flash_status *report,
                         vc_rejection *rejection)
{
    int rejected = reject_unless_taking(store, data->slot, ": begin with FlashBegin", rejection);
    if (rejected)
        return rejected;
    if (data->offset == store->written[data->slot]) {
        uint32_t size_bytes = slot_of(store, data->slot)->size_bytes;
        if (data->data.length > size_bytes - data->offset)
            return vc_reject_numbers(rejection, VC_BAD_VALUE, "data up to byte # of an image of # bytes",
                                     data->offset + (uint64_t)data->data.length, size_bytes);
        if (!program(store, data))
            return flash_failed(rejection);
    }
    return tell(store, data->slot, report);
}

/* Checks the image in a slot. Returns 0, or the rejection's code. */
static int check_image(vc_image_store *store, unsigned number, vc_rejection *rejection)
{
    const vc_model_image *image = &store->images[number];
    int rejected = look_at_image(store, number, rejection);
    if (!rejected)
        rejected = reject_outdated(store, image, rejection);
    if (!rejected)
        rejected = wrong_hardware(store, image->hardware, VC_IMAGE_REJECTED, rejection);
    if (!rejected && image->codec == VC_IMAGE_OF_ACTUATOR)
        rejected = actuator_of(image, store->settings->actuator, rejection) == NULL ? VC_IMAGE_REJECTED : 0;
    else if (!rejected)
        rejected =
            store->check(store->check_context, image->codec, image->payload.bytes, image->payload.length, rejection);
    return rejected;
}

int vc_image_store_verify(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot verified;
    int rejected = reject_unless_taking(store, number, ": there is nothing new to verify", rejection);
    if (rejected)
        return rejected;
    rejected = check_image(store, number, rejection);
    if (rejected)
        return set_slot(store, number, &empty_slot) ? rejected : flash_failed(rejection);
    verified = *slot_of(store, number);
    verified.state = VC_SLOT_VERIFIED;
    return set_slot(store, number, &verified) ? tell(store, number, report) : flash_failed(rejection);
}

int vc_image_store_activate(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot tested;
    int rejected = no_such_slot(store, number, rejection);
    if (!rejected)
        rejected = reject_while_testing(store, rejection);
    if (!rejected)
        rejected = not_in_state(store, number, VC_SLOT_VERIFIED, ": only a verified one can be tested", rejection);
    if (!rejected)
        rejected = reject_outdated(store, &store->images[number], rejection);
    if (!rejected)
        rejected = reject_wear(store, rejection);
    if (rejected)
        return rejected;
    tested = *slot_of(store, number);
    tested.state = VC_SLOT_TESTING;
    return set_slot(store, number, &tested) ? tell(store, number, report) : flash_failed(rejection);
}

int vc_image_store_confirm(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    vc_slot_entry entry = store->record.entry;
    unsigned i;
    int rejected = no_such_slot(store, number, rejection);
    if (rejected)
        return rejected;
    if ((int)number != store->running)
        return vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # does not run: only what has been tried can be kept",
                                 number, 0);
    if (slot_of(store, number)->state == VC_SLOT_TESTING) {
        for (i = 0; i < VC_SLOTS; i++)
            if (entry.slots[i].state == VC_SLOT_CONFIRMED)
                entry.slots[i].state = VC_SLOT_VERIFIED;
        entry.slots[number].state = VC_SLOT_CONFIRMED;
        entry.slots[number].booted = 0;
        /* Without a key, nothing vouches for the number. */
        if (store->settings->public_key != NULL)
            entry.lowest_number = store->images[number].number;
        if (!set_entry(store, &entry))
            return flash_failed(rejection);
    }
    return tell(store, number, report);
}

int vc_image_store_erase(vc_image_store *store, unsigned number, vc_flash_status *report, vc_rejection *rejection)
{
    int rejected = no_such_slot(store, number, rejection);
    if (!rejected)
        rejected = reject_in_use(store, number, rejection);
    if (!rejected)
        rejected = reject_wear(store, rejection);
    if (!rejected)
        rejected = erase_slot(store, number, rejection);
    return rejected ? rejected : tell(store, number, report);
}

int vc_image_store_read(const vc_image_store *store, const vc_flash_read *read, vc_flash_contents *contents,
                        vc_rejection *rejection)
{
    const vc_slot *slot;
    uint32_t left;
    int rejected = no_such_slot(store, read->slot, rejection);
    if (rejected)
        return rejected;
    slot = slot_of(store, read->slot);
    if (slot->state <= VC_SLOT_WRITING)
        return vc_reject_numbers(rejection, VC_WRONG_STATE, "slot # holds no whole image: read another", read->slot, 0);
    contents->slot = read->slot;
    contents->size_bytes = slot->size_bytes;
    contents->offset = read->offset < slot->size_bytes ? read->offset : slot->size_bytes;
    left = slot->size_bytes - contents->offset;
    contents->data.bytes = slot_data(store, read->slot) + contents->offset;
    contents->data.length = read->count < left ? read->count : left;
    return 0;
}
