/* The codecs that a controller decodes, behind one interface; see decoders.h. */
#include "decoders.h"

enum { MDCT = 1, DCT = 2, SLP = 3, EVA = 4, PARAMETRIC = 11 };

#define EVA_LAYOUT_VERSION 1

const vc_codec_description vc_codecs[VC_CODECS] = {
    {MDCT, "mdct"}, {DCT, "dct"}, {SLP, "slp"}, {EVA, "eva"}, {PARAMETRIC, "parametric"}};

/* Returns 0 if a codec's decoder takes the payload of a model image; else refuses with `code`. */
static int check_tables(uint8_t codec, const uint8_t *tables, size_t length, enum vc_error_code code,
                        vc_refusal *refusal)
{
    vc_eva_model model;
    switch (codec) {
    case MDCT:
        return vc_model_check_tables(tables, length) == VC_OK
                   ? 0
                   : vc_refuse(refusal, code, "tables of the wrong size for mdct: export them again");
    case EVA:
        if (length > 0 && tables[0] != EVA_LAYOUT_VERSION)
            return vc_refuse_numbers(refusal, code,
                                     "a model image of EVA with layout #; this controller reads layout #", tables[0],
                                     EVA_LAYOUT_VERSION);
        if (vc_eva_model_read(&model, tables, length) != VC_OK)
            return vc_refuse(refusal, code, "the model image of EVA is damaged; export it again");
        return model.has_network ? 0
                                 : vc_refuse(refusal, code,
                                             "the model has no integer network, the only one that this controller "
                                             "runs: export it with one");
    default:
        return vc_refuse_numbers(refusal, code, "codec # takes no model image on this controller", codec, 0);
    }
}

int vc_tables_check(uint8_t codec, const uint8_t *tables, size_t length, vc_refusal *refusal)
{
    return check_tables(codec, tables, length, VC_IMAGE_REFUSED, refusal);
}

int vc_coding_check(vc_coding *coding, vc_refusal *refusal)
{
    union {
        vc_mdct_configuration mdct;
        vc_dct_configuration dct;
        vc_slp_configuration slp;
        vc_eva_configuration eva;
        vc_parametric_configuration parametric;
    } read;
    vc_eva_model model;
    const uint8_t *bytes = coding->configuration;
    const size_t length = coding->configuration_length;
    int status;
    if (coding->tables != NULL &&
        check_tables(coding->codec, coding->tables, coding->tables_length, VC_UNKNOWN_CODEC, refusal))
        return VC_UNKNOWN_CODEC;
    coding->delay_samples = 0;
    switch (coding->codec) {
    case MDCT:
        status = vc_configuration_read(&read.mdct, bytes, length, coding->channels);
        if (status == VC_OK) {
            coding->packet_samples = read.mdct.packet_blocks * read.mdct.hop;
            coding->delay_samples = read.mdct.hop;
        }
        break;
    case DCT:
        status = vc_dct_configuration_read(&read.dct, bytes, length, coding->channels);
        if (status == VC_OK)
            coding->packet_samples = read.dct.packet_blocks * read.dct.block;
        break;
    case SLP:
        status = vc_slp_configuration_read(&read.slp, bytes, length, coding->channels);
        if (status == VC_OK)
            coding->packet_samples = read.slp.packet_frames * read.slp.frame;
        break;
    case EVA:
        if (coding->tables == NULL)
            return vc_refuse(refusal, VC_UNKNOWN_CODEC,
                             "the codec eva needs a model: flash the model image that the stream was coded for");
        status = vc_eva_model_read(&model, coding->tables, coding->tables_length);
        if (status == VC_OK)
            status = vc_eva_configuration_read(&read.eva, &model, bytes, length, coding->channels);
        if (status == VC_OK) {
            coding->packet_samples = read.eva.packet_columns * VC_EVA_HOP;
            coding->delay_samples = VC_EVA_DELAY;
        }
        break;
    case PARAMETRIC:
        status = vc_parametric_configuration_read(&read.parametric, bytes, length, coding->channels);
        if (status == VC_OK) {
            coding->packet_samples = read.parametric.packet_frames * vc_parametric_frame_samples(&read.parametric);
            coding->delay_samples = read.parametric.hop;
        }
        break;
    default:
        return vc_refuse_numbers(refusal, VC_UNKNOWN_CODEC, "codec # is needed, which this controller does not have",
                                 coding->codec, 0);
    }
    return status == VC_OK
               ? 0
               : vc_refuse(refusal, VC_UNKNOWN_CODEC, "the codec configuration is damaged or of another version");
}

void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding)
{
    const uint8_t *bytes = coding->configuration, *tables = coding->tables;
    const size_t length = coding->configuration_length, tables_length = coding->tables_length;
    decoder->codec = coding->codec;
    switch (coding->codec) {
    case MDCT:
        (void)vc_mdct_decoder_init(&decoder->of.mdct, bytes, length, coding->channels, tables, tables_length);
        break;
    case DCT:
        (void)vc_dct_decoder_init(&decoder->of.dct, bytes, length, coding->channels);
        break;
    case SLP:
        (void)vc_slp_decoder_init(&decoder->of.slp, bytes, length, coding->channels);
        break;
    case PARAMETRIC:
        (void)vc_parametric_decoder_init(&decoder->of.parametric, bytes, length, coding->channels);
        break;
    default:
        (void)vc_eva_decoder_init(&decoder->of.eva, bytes, length, coding->channels, tables, tables_length);
        break;
    }
}

int vc_decoder_decode(vc_decoder *decoder, const uint8_t *packet, size_t length, int16_t *samples)
{
    switch (decoder->codec) {
    case MDCT:
        return vc_mdct_decode(&decoder->of.mdct, packet, length, samples) >= VC_OK;
    case DCT:
        return vc_dct_decode(&decoder->of.dct, packet, length, samples) >= VC_OK;
    case SLP:
        return vc_slp_decode(&decoder->of.slp, packet, length, samples) >= VC_OK;
    case PARAMETRIC:
        return vc_parametric_decode(&decoder->of.parametric, packet, length, samples) >= VC_OK;
    default:
        return vc_eva_decode(&decoder->of.eva, packet, length, samples) >= VC_OK;
    }
}

void vc_decoder_conceal(vc_decoder *decoder, int16_t *samples)
{
    switch (decoder->codec) {
    case MDCT:
        vc_mdct_conceal(&decoder->of.mdct, samples);
        break;
    case DCT:
        vc_dct_conceal(&decoder->of.dct, samples);
        break;
    case SLP:
        vc_slp_conceal(&decoder->of.slp, samples);
        break;
    case PARAMETRIC:
        vc_parametric_conceal(&decoder->of.parametric, samples);
        break;
    default:
        vc_eva_conceal(&decoder->of.eva, samples);
        break;
    }
}
