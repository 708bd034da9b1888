/* The codecs that a controller decodes, behind one interface; see decoders.h. */
#include "decoders.h"

enum { MDCT = 1, DCT = 2, SLP = 3, EVA = 4 };

#define EVA_LAYOUT_VERSION 1

const vc_codec_description vc_codecs[VC_CODECS] = {{MDCT, "mdct"}, {DCT, "dct"}, {SLP, "slp"}, {EVA, "eva"}};

const char *vc_tables_check(uint8_t codec, const uint8_t *tables, size_t length)
{
    vc_eva_model model;
    switch (codec) {
    case MDCT:
        return vc_model_check_tables(tables, length) == VC_OK ? NULL
                                                              : "tables of the wrong size for mdct: export them again";
    case EVA:
        if (length > 0 && tables[0] != EVA_LAYOUT_VERSION)
            return "a model image of EVA with another layout than 1: update the older of host and controller";
        if (vc_eva_model_read(&model, tables, length) != VC_OK)
            return "the model image of EVA is damaged; export it again";
        return model.has_network ? NULL : "the model has no integer network, which this controller needs: export it";
    case DCT:
    case SLP:
        return "this codec takes no model image";
    default:
        return "the model image is of a codec that this controller does not have";
    }
}

const char *vc_coding_check(const vc_coding *coding, vc_packet_shape *shape)
{
    union {
        vc_mdct_configuration mdct;
        vc_dct_configuration dct;
        vc_slp_configuration slp;
        vc_eva_configuration eva;
    } read;
    vc_eva_model model;
    const uint8_t *bytes = coding->configuration;
    const size_t length = coding->configuration_length;
    const char *refusal =
        coding->tables != NULL ? vc_tables_check(coding->codec, coding->tables, coding->tables_length) : NULL;
    int status = VC_BAD_CONFIGURATION;
    if (refusal != NULL)
        return refusal;
    shape->delay_samples = 0;
    switch (coding->codec) {
    case MDCT:
        status = vc_configuration_read(&read.mdct, bytes, length, coding->channels);
        if (status == VC_OK) {
            shape->packet_samples = read.mdct.packet_blocks * read.mdct.hop;
            shape->delay_samples = read.mdct.hop;
        }
        break;
    case DCT:
        status = vc_dct_configuration_read(&read.dct, bytes, length, coding->channels);
        if (status == VC_OK)
            shape->packet_samples = read.dct.packet_blocks * read.dct.block;
        break;
    case SLP:
        status = vc_slp_configuration_read(&read.slp, bytes, length, coding->channels);
        if (status == VC_OK)
            shape->packet_samples = read.slp.packet_frames * read.slp.frame;
        break;
    case EVA:
        if (coding->tables == NULL)
            return "the codec eva needs a model: the stream has to name the model image that runs here";
        status = vc_eva_model_read(&model, coding->tables, coding->tables_length);
        if (status == VC_OK)
            status = vc_eva_configuration_read(&read.eva, &model, bytes, length, coding->channels);
        if (status == VC_OK) {
            shape->packet_samples = read.eva.packet_columns * VC_EVA_HOP;
            shape->delay_samples = VC_EVA_DELAY;
        }
        break;
    default:
        return "the stream is of a codec that this controller does not have";
    }
    return status == VC_OK ? NULL : "the codec configuration is damaged or of another version";
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
    default:
        vc_eva_conceal(&decoder->of.eva, samples);
        break;
    }
}
