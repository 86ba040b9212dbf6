//! Agreement with evo 1.38.1, whose numbers these are, to 1e-9.

use std::path::PathBuf;

use approx::assert_relative_eq;
use nalgebra::{Isometry3, UnitQuaternion, vector};

use super::*;

/// rmse, mean, median, std, min, max, sse.
type Golden = [f64; 7];

/// Below this (m, deg) an error is rounding.
const FLOOR: f64 = 1e-12;

#[track_caller]
fn assert_agrees(statistics: &Statistics, golden: &Golden, case: &str) {
    for ((name, ours), theirs) in statistics.entries().iter().zip(golden) {
        let close = (ours - theirs).abs() <= 1e-9 * theirs.abs() || ours.abs().max(*theirs) < FLOOR;
        assert!(close, "{case}: {name} {ours} instead of {theirs}");
    }
}

/// Two curves that differ in place, heading and shape.
fn curves() -> (Trajectory, Trajectory) {
    let stamps: Vec<f64> = (0..60).map(|i| f64::from(i) * 0.1).collect();
    let trajectory = |pose: &dyn Fn(f64) -> Isometry3<f64>| {
        let poses = stamps.iter().map(|t| pose(*t)).collect();
        Trajectory::new(stamps.clone(), poses).unwrap()
    };
    let reference = trajectory(&|t| {
        let position = vector![3.0 * (0.7 * t).sin(), 2.0 * (0.9 * t).cos(), 0.5 * t];
        let rotation = UnitQuaternion::from_scaled_axis(vector![0.8 * t, -0.5 * t, 0.3]);
        Isometry3::from_parts(position.into(), rotation)
    });
    let estimate = trajectory(&|t| {
        let position = vector![
            2.9 * (0.7 * t + 0.02).sin() + 1.0,
            0.4 * t * 0.5 - 2.0 + 2.0 * (0.9 * t).cos() * 0.1,
            2.1 * (0.9 * t + 0.05).cos()
        ];
        let rotation = UnitQuaternion::from_scaled_axis(vector![
            0.8 * t + 0.03,
            0.1 * t.sin() - 0.5 * t,
            0.28
        ]);
        Isometry3::from_parts(position.into(), rotation)
    });
    (reference, estimate)
}

#[test]
fn absolute_errors_of_two_curves() {
    let (reference, estimate) = curves();
    for (alignment, align_n, relation, golden) in CURVES_APE {
        let options = ApeOptions { alignment, align_n, relation, ..Default::default() };
        let result = ape(&reference, &estimate, &options).unwrap();
        assert_agrees(&result.statistics, &golden, &format!("{alignment} {relation:?}"));
    }
}

#[test]
fn relative_errors_of_two_curves() {
    let (reference, estimate) = curves();
    for (delta, all_pairs, relation, golden) in CURVES_RPE {
        let options = RpeOptions { delta, all_pairs, relation, ..Default::default() };
        let result = rpe(&reference, &estimate, &options).unwrap();
        assert_agrees(&result.statistics, &golden, &format!("{delta:?} {all_pairs} {relation:?}"));
    }
}

/// The folder of real data; says so on standard error where there is none.
fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("MFG_VIO_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    if folder.join("evo").is_dir() {
        return Some(folder);
    }
    eprintln!("SKIPPED: no data at {}; set MFG_VIO_DATA", folder.display());
    None
}

fn read(folder: &std::path::Path, name: &str) -> Trajectory {
    read_trajectory(&folder.join(name)).unwrap().trajectory
}

#[test]
fn absolute_errors_of_real_trajectories() {
    let Some(folder) = data() else { return };
    for (reference, estimate, alignment, relation, matched, golden) in REAL_APE {
        let options = ApeOptions { alignment, relation, ..Default::default() };
        let result = ape(&read(&folder, reference), &read(&folder, estimate), &options).unwrap();
        assert_eq!(result.pairs.len(), matched, "{estimate}");
        assert_agrees(&result.statistics, &golden, &format!("{estimate} {alignment} {relation:?}"));
    }
}

#[test]
fn relative_errors_of_a_real_trajectory() {
    let Some(folder) = data() else { return };
    let (reference, estimate) =
        (read(&folder, "evo/V102_groundtruth.csv"), read(&folder, "evo/V102.txt"));
    for (delta, all_pairs, relation, golden) in V102_RPE {
        let options = RpeOptions { delta, all_pairs, relation, ..Default::default() };
        let result = rpe(&reference, &estimate, &options).unwrap();
        assert_agrees(&result.statistics, &golden, &format!("{delta:?} {all_pairs} {relation:?}"));
    }
}

#[test]
fn published_errors_of_the_vcu_rvi_results() {
    let Some(folder) = data() else { return };
    let folder = folder.join("vcu_rvi");
    let table = std::fs::read_to_string(folder.join("ape_reference_evo.csv")).unwrap();
    let mut compared = 0;
    for line in table.lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let estimate = folder.join(format!("results/{}/{}_tum.csv", fields[0], fields[1]));
        if !estimate.exists() {
            eprintln!("SKIPPED: {} is not there", estimate.display());
            continue;
        }
        let reference = read(&folder, &format!("ground_truths/{}_gt.csv", fields[1]));
        let estimate = read_trajectory(&estimate).unwrap().trajectory;
        let statistics = |alignment, relation| {
            let options = ApeOptions { alignment, relation, ..Default::default() };
            let result = ape(&reference, &estimate, &options).unwrap();
            assert_eq!(result.pairs.len().to_string(), fields[2], "{line}");
            result.statistics
        };
        let aligned = statistics(Alignment::Se3, Relation::Translation);
        let angle = statistics(Alignment::Se3, Relation::Angle);
        let unaligned = statistics(Alignment::None, Relation::Translation);
        let ours = [aligned.rmse, aligned.mean, aligned.max, angle.rmse, unaligned.rmse];
        for (value, field) in ours.iter().zip(&fields[3..]) {
            let published: f64 = field.parse().unwrap();
            assert!((value - published).abs() <= 5.1e-7, "{line}: {value}");
        }
        compared += 1;
    }
    assert!(compared >= 32, "{compared}");
}

/// The formulas of OpenVINS (`get_best_yaw`) on the nearest poses, and on the poses that its own
/// loop over the stamps pairs, evaluated elsewhere: position (m), attitude (deg), yaw (deg).
#[test]
fn yaw_alignment_is_that_of_openvins() {
    let Some(folder) = data() else { return };
    let reference = read(&folder, "evo/V102_groundtruth.csv");
    let estimate = read(&folder, "evo/V102.txt");
    let nearest = [0.091_842_790_529_388_87, 2.723_994_425_339_067_8, -26.423_107_798_166_03];
    let openvins = [0.091_846_456_589_099_22, 2.723_926_296_991_213_5, -26.422_858_824_532_852];
    for (rule, golden) in
        [(AssociationRule::Nearest, nearest), (AssociationRule::OpenVins, openvins)]
    {
        let association = AssociationOptions { rule, max_diff: 0.02, time_offset: 0.0 };
        let options = ApeOptions { association, alignment: Alignment::Yaw, ..Default::default() };
        let translation = ape(&reference, &estimate, &options).unwrap();
        let options = ApeOptions { relation: Relation::Angle, ..options };
        let angle = ape(&reference, &estimate, &options).unwrap();
        assert_eq!(translation.pairs.len(), 798);
        let yaw = translation.alignment.yaw().to_degrees();
        let found = [translation.statistics.rmse, angle.statistics.rmse, yaw];
        for (value, expected) in found.iter().zip(golden) {
            assert_relative_eq!(*value, expected, max_relative = 1e-9);
        }
    }
}

const CURVES_APE: [(Alignment, Option<usize>, Relation, Golden); 10] = [
    (
        Alignment::Se3,
        None,
        Relation::Translation,
        [
            0.4276519724392506,
            0.3672276872790594,
            0.3189904260781954,
            0.2191575579961935,
            0.03761063687564191,
            1.1943765336271266,
            10.973172571870895,
        ],
    ),
    (
        Alignment::Sim3,
        None,
        Relation::Translation,
        [
            0.41463664037843756,
            0.3587417613070444,
            0.30366128247415003,
            0.20791318437905112,
            0.14130586698024977,
            1.1954001306939768,
            10.315412612659067,
        ],
    ),
    (
        Alignment::Origin,
        None,
        Relation::Translation,
        [
            5.2286653593211945,
            4.669928777478512,
            5.300066470612365,
            2.35174544818173,
            2.220446049250313e-16,
            7.325659128257394,
            1640.3364863859258,
        ],
    ),
    (
        Alignment::None,
        None,
        Relation::Translation,
        [
            3.3255399464481163,
            3.2588560309182117,
            3.279086796313665,
            0.6626260673789851,
            2.1177175556649375,
            4.467475797668071,
            663.5529561253284,
        ],
    ),
    (
        Alignment::Sim3,
        Some(25),
        Relation::Translation,
        [
            1.749629556507704,
            1.0942045304545234,
            0.30886373010954804,
            1.3652545662029998,
            0.010299394211847283,
            4.306107013196969,
            183.67221510032073,
        ],
    ),
    (
        Alignment::Se3,
        None,
        Relation::Angle,
        [
            121.2065748653206,
            121.18732220022144,
            121.25399441501932,
            2.1602612162154418,
            118.07064244772629,
            124.24429525540022,
            881462.0274349542,
        ],
    ),
    (
        Alignment::Sim3,
        None,
        Relation::Angle,
        [
            121.2065748653206,
            121.18732220022144,
            121.25399441501932,
            2.1602612162154418,
            118.07064244772629,
            124.24429525540022,
            881462.0274349542,
        ],
    ),
    (
        Alignment::Origin,
        None,
        Relation::Angle,
        [
            3.7112227892210075,
            3.372349614038994,
            3.060076326833684,
            1.5493329764529005,
            7.569105486689317e-17,
            6.141770347713326,
            826.3904754740013,
        ],
    ),
    (
        Alignment::None,
        None,
        Relation::Angle,
        [
            3.9440896126467866,
            3.770766327443425,
            3.9358535450391434,
            1.156358152307106,
            1.6655970358287866,
            5.60604606530486,
            933.3505723552967,
        ],
    ),
    (
        Alignment::Sim3,
        Some(25),
        Relation::Angle,
        [
            100.08537507536576,
            100.0782457896541,
            100.57500977421685,
            1.1945809483774437,
            98.04126360513169,
            101.59604097294692,
            601024.9382385988,
        ],
    ),
];

const CURVES_RPE: [(Delta, bool, Relation, Golden); 24] = [
    (
        Delta::Frames(1),
        false,
        Relation::Translation,
        [
            0.19166705686354885,
            0.17525125451298745,
            0.1804493105733838,
            0.07760965454348424,
            0.01350592058522186,
            0.2928562123948092,
            2.1674393805173575,
        ],
    ),
    (
        Delta::Frames(1),
        true,
        Relation::Translation,
        [
            0.19166705686354885,
            0.17525125451298745,
            0.1804493105733838,
            0.07760965454348424,
            0.01350592058522186,
            0.2928562123948092,
            2.1674393805173575,
        ],
    ),
    (
        Delta::Frames(7),
        false,
        Relation::Translation,
        [
            1.3433598230052268,
            1.2299697252802917,
            1.1708902860620767,
            0.5401759796201212,
            0.23870115752567642,
            2.018874843621815,
            14.436924912517073,
        ],
    ),
    (
        Delta::Frames(7),
        true,
        Relation::Translation,
        [
            1.3671878394836208,
            1.2531669810087995,
            1.2815017016197627,
            0.5466032438077748,
            0.10418813649856089,
            2.018874843621815,
            99.0677371868902,
        ],
    ),
    (
        Delta::Metres(0.5),
        false,
        Relation::Translation,
        [
            0.5806790743755977,
            0.5181119179489512,
            0.47286200482953944,
            0.2621988327528563,
            0.10740403581691517,
            1.062301572533091,
            6.74376374835402,
        ],
    ),
    (
        Delta::Metres(0.5),
        true,
        Relation::Translation,
        [
            0.504978204667515,
            0.44500989588149337,
            0.37334268170276785,
            0.23868217310215936,
            0.04141150437511865,
            0.8560424383615939,
            7.6500896156768,
        ],
    ),
    (
        Delta::Metres(2.0),
        false,
        Relation::Translation,
        [
            2.0275444925751205,
            1.8096222247624678,
            1.6379622146953892,
            0.9144419462259159,
            0.41736261629437216,
            2.8468229073122275,
            20.554683346858518,
        ],
    ),
    (
        Delta::Metres(2.0),
        true,
        Relation::Translation,
        [
            1.910320150451503,
            1.6953963128155096,
            1.5146037446488156,
            0.8803149548386807,
            0.14948413453973128,
            3.176575084268157,
            189.76480001549479,
        ],
    ),
    (
        Delta::Degrees(10.0),
        false,
        Relation::Translation,
        [
            0.3845281513973892,
            0.35132522233454455,
            0.3626914111128917,
            0.15630894846001725,
            0.022129924854885588,
            0.5837028020238545,
            4.287995077295711,
        ],
    ),
    (
        Delta::Degrees(10.0),
        true,
        Relation::Translation,
        [
            0.4131326941985214,
            0.39723925066150595,
            0.37334268170276785,
            0.11348832869336921,
            0.17048817729373592,
            0.5852451486831938,
            5.803073182534785,
        ],
    ),
    (
        Delta::Degrees(45.0),
        false,
        Relation::Translation,
        [
            1.7006209671798855,
            1.5514026895948974,
            1.4759116509621788,
            0.6966070403962106,
            0.470259236347565,
            2.4337178420634973,
            17.352670044071097,
        ],
    ),
    (
        Delta::Degrees(45.0),
        true,
        Relation::Translation,
        [
            1.8718665505485366,
            1.69677885201975,
            1.619514430750074,
            0.7904593034439008,
            0.08507364469311612,
            4.410339069237415,
            287.31851941112313,
        ],
    ),
    (
        Delta::Frames(1),
        false,
        Relation::Angle,
        [
            0.35700287018846255,
            0.32859325597189776,
            0.3131054686052249,
            0.139561891118554,
            0.09286474174362061,
            0.6170984922055099,
            7.519611910045215,
        ],
    ),
    (
        Delta::Frames(1),
        true,
        Relation::Angle,
        [
            0.35700287018846255,
            0.32859325597189776,
            0.3131054686052249,
            0.139561891118554,
            0.09286474174362061,
            0.6170984922055099,
            7.519611910045215,
        ],
    ),
    (
        Delta::Frames(7),
        false,
        Relation::Angle,
        [
            2.441122352964271,
            2.23337252194112,
            2.142822012136457,
            0.9854570109244658,
            0.601862808580852,
            3.9765374262329582,
            47.672626737134564,
        ],
    ),
    (
        Delta::Frames(7),
        true,
        Relation::Angle,
        [
            2.309694214333823,
            2.132280247344727,
            2.091455537571533,
            0.8877321164127413,
            0.601862808580852,
            3.9765374262329582,
            282.73843027753816,
        ],
    ),
    (
        Delta::Metres(0.5),
        false,
        Relation::Angle,
        [
            1.1133577903121477,
            0.9639675895388367,
            0.8275179449440921,
            0.5570745511755432,
            0.18461785000906103,
            1.8275546838004646,
            24.791311384974957,
        ],
    ),
    (
        Delta::Metres(0.5),
        true,
        Relation::Angle,
        [
            1.008113781402122,
            0.822095753068771,
            0.5093903020763821,
            0.5834826210258329,
            0.18461785000906103,
            1.8035586895269016,
            30.488801887586558,
        ],
    ),
    (
        Delta::Metres(2.0),
        false,
        Relation::Angle,
        [
            3.7278763245754813,
            3.2501796002432406,
            2.380140199848377,
            1.8257585978143678,
            0.8449224498066878,
            5.581238309802667,
            69.48530945665199,
        ],
    ),
    (
        Delta::Metres(2.0),
        true,
        Relation::Angle,
        [
            3.4219157479381943,
            3.0419843041509336,
            2.92725879999089,
            1.567111635872434,
            0.666254465462536,
            5.6564383829205385,
            608.8943840713455,
        ],
    ),
    (
        Delta::Degrees(10.0),
        false,
        Relation::Angle,
        [
            0.714660423503177,
            0.6571391448343126,
            0.6164776190611373,
            0.2809050822754348,
            0.1907934001673647,
            1.2284851210890153,
            14.81144610673047,
        ],
    ),
    (
        Delta::Degrees(10.0),
        true,
        Relation::Angle,
        [
            0.6920816705035473,
            0.6158199343067622,
            0.5389282191972489,
            0.31582090994327106,
            0.18461785000906103,
            1.2284851210890153,
            16.28521931399734,
        ],
    ),
    (
        Delta::Degrees(45.0),
        false,
        Relation::Angle,
        [
            3.0489630119206157,
            2.8000976346033024,
            2.77631802976382,
            1.2064943782500703,
            1.0117309206098488,
            4.826195298722861,
            55.77705268836019,
        ],
    ),
    (
        Delta::Degrees(45.0),
        true,
        Relation::Angle,
        [
            2.591435336301242,
            2.3730443524873253,
            2.2409547917444392,
            1.041248098850002,
            0.666254465462536,
            4.826195298722861,
            550.6740423829201,
        ],
    ),
];

const REAL_APE: [(&str, &str, Alignment, Relation, usize, Golden); 12] = [
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Se3,
        Relation::Translation,
        2174,
        [
            0.008118977562045396,
            0.007491776870216619,
            0.0074146298293173854,
            0.0031290695070394156,
            0.00034963619840638655,
            0.024299593694385224,
            0.14330528992361463,
        ],
    ),
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Sim3,
        Relation::Translation,
        2174,
        [
            0.006123163030157291,
            0.005586197318706158,
            0.005305225075852879,
            0.0025074937707530087,
            0.0001897958096084112,
            0.021476785562787627,
            0.08151005482370602,
        ],
    ),
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Origin,
        Relation::Translation,
        2174,
        [
            0.042015511713436704,
            0.034069931767972746,
            0.028488955204609347,
            0.024587455620043695,
            0.0,
            0.08431421697474216,
            3.8377692101541707,
        ],
    ),
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Se3,
        Relation::Angle,
        2174,
        [
            0.9890356583679113,
            0.959473081701525,
            0.9498012380328416,
            0.24000612286653536,
            0.1329505170355609,
            2.0248712164605105,
            2126.5883938795405,
        ],
    ),
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Sim3,
        Relation::Angle,
        2174,
        [
            0.9890356583679113,
            0.959473081701525,
            0.9498012380328416,
            0.24000612286653536,
            0.1329505170355609,
            2.0248712164605105,
            2126.5883938795405,
        ],
    ),
    (
        "evo/fr2_desk_groundtruth.txt",
        "evo/fr2_desk_ORB.txt",
        Alignment::Origin,
        Relation::Angle,
        2174,
        [
            1.2746108401483869,
            1.1533500869944024,
            1.1288375116683258,
            0.5426014841979157,
            0.0,
            3.082003485184244,
            3531.9516937728904,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Se3,
        Relation::Translation,
        798,
        [
            0.09172711520685733,
            0.08152162194619834,
            0.07791194901949527,
            0.042048648247395404,
            0.002619987097383053,
            0.25581673381397085,
            6.714263204009318,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Sim3,
        Relation::Translation,
        798,
        [
            0.08384138804295284,
            0.0748410847826337,
            0.07194517866622532,
            0.03779140613324187,
            0.0070002905794235674,
            0.22665179238276975,
            5.609443922477258,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Origin,
        Relation::Translation,
        798,
        [
            0.15367889158366102,
            0.14010464607318202,
            0.1471745104278056,
            0.06314974162331187,
            0.0,
            0.32195402081857327,
            18.846526971269345,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Se3,
        Relation::Angle,
        798,
        [
            2.71677136027806,
            2.3085053408437446,
            1.9547123911623374,
            1.432358096051056,
            0.221063365718752,
            9.911251434936856,
            5889.915605973626,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Sim3,
        Relation::Angle,
        798,
        [
            2.71677136027806,
            2.3085053408437446,
            1.9547123911623374,
            1.432358096051056,
            0.221063365718752,
            9.911251434936856,
            5889.915605973626,
        ],
    ),
    (
        "evo/V102_groundtruth.csv",
        "evo/V102.txt",
        Alignment::Origin,
        Relation::Angle,
        798,
        [
            3.355549326535856,
            3.1186982388652265,
            2.8142538986626353,
            1.238318447619259,
            2.488203627578759e-15,
            9.81917642568955,
            8985.24960368656,
        ],
    ),
];

const V102_RPE: [(Delta, bool, Relation, Golden); 12] = [
    (
        Delta::Frames(10),
        false,
        Relation::Translation,
        [
            0.057522051461090906,
            0.04499027517479799,
            0.0371233464345716,
            0.03584217549184684,
            0.003612711372751738,
            0.21805078291626248,
            0.26139412593909883,
        ],
    ),
    (
        Delta::Frames(10),
        true,
        Relation::Translation,
        [
            0.05567504013258814,
            0.04394540167998637,
            0.036252234351192764,
            0.034183501355916586,
            0.0006119511323282999,
            0.22121983988430866,
            2.4425715538870563,
        ],
    ),
    (
        Delta::Metres(0.5),
        false,
        Relation::Translation,
        [
            0.04034647330759034,
            0.028830595589758295,
            0.021812435568235436,
            0.02822471729353386,
            0.006737387982820568,
            0.22103716659772502,
            0.2246416313536938,
        ],
    ),
    (
        Delta::Metres(0.5),
        true,
        Relation::Translation,
        [
            0.03736459499474497,
            0.025971246034957242,
            0.01917400157499071,
            0.026862750017692505,
            0.001779699370843443,
            0.22433417411646372,
            0.9367917955704064,
        ],
    ),
    (
        Delta::Degrees(10.0),
        false,
        Relation::Translation,
        [
            0.02728321960631413,
            0.01781937160296061,
            0.012013413974331201,
            0.02066020493029932,
            0.002054564710368086,
            0.1596009045921045,
            0.16376229585899998,
        ],
    ),
    (
        Delta::Degrees(10.0),
        true,
        Relation::Translation,
        [
            0.1355718905365839,
            0.10868997037913673,
            0.08754423653694893,
            0.08103226420781949,
            0.001804424542969833,
            0.4865672055547522,
            94.63726840636328,
        ],
    ),
    (
        Delta::Frames(10),
        false,
        Relation::Angle,
        [
            1.2943706668898765,
            0.601750307112958,
            0.2550882267350673,
            1.1459895249060543,
            0.031005467177142046,
            8.26477482026725,
            132.35623844109054,
        ],
    ),
    (
        Delta::Frames(10),
        true,
        Relation::Angle,
        [
            1.1295830621113825,
            0.5680770692074207,
            0.243929491857038,
            0.9763433502869953,
            0.01857519509282873,
            8.26477482026725,
            1005.4548206366346,
        ],
    ),
    (
        Delta::Metres(0.5),
        false,
        Relation::Angle,
        [
            0.9906894819516472,
            0.3726712275029852,
            0.15466120751837614,
            0.9179225489337549,
            0.00692324435168353,
            8.26477482026725,
            135.442259651648,
        ],
    ),
    (
        Delta::Metres(0.5),
        true,
        Relation::Angle,
        [
            1.0978176884264257,
            0.44815862854881333,
            0.14925208327794073,
            1.0021763919985278,
            0.00866849347378123,
            8.26477482026725,
            808.6916672817221,
        ],
    ),
    (
        Delta::Degrees(10.0),
        false,
        Relation::Angle,
        [
            0.7015114451376615,
            0.22586575837861464,
            0.08987495560763681,
            0.6641558302470767,
            0.008996083806835484,
            8.26477482026725,
            108.26602768500867,
        ],
    ),
    (
        Delta::Degrees(10.0),
        true,
        Relation::Angle,
        [
            4.092080210185462,
            2.69652800252011,
            1.4703362212283928,
            3.0779631541356047,
            0.008996083806835484,
            13.687659707112475,
            86220.6251794996,
        ],
    ),
];
